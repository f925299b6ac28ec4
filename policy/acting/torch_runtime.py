"""PolicyRuntime that runs the torch network itself, for actors that have torch installed (`--runtime torch`)."""

import numpy as np
import torch

from daedalus.policy.acting.runtime import PolicyError
from daedalus.policy.acting.sampling import SAMPLERS, RandomSource
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.errors import NetworkError
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec


class TorchRuntime:
    """Runs the network with torch on one thread."""

    def __init__(self, spec: PolicySpec, spaces: Spaces) -> None:
        """Raise PolicyError if the network cannot be built, or has an encoder that the user supplies."""
        if ":" in spec.encoder:
            # The name came over the wire; importing it would execute code that another process chose.
            raise PolicyError(f"the encoder {spec.encoder!r} is custom code, not imported here: use --runtime onnx")
        torch.set_num_threads(1)
        try:
            self._network = ActorCritic(spec, spaces).eval().requires_grad_(False)
        except NetworkError as error:
            raise PolicyError(str(error)) from None
        self._sampler = SAMPLERS[self._network.distribution.program_output]
        self._parameters = dict(self._network.named_parameters())
        self._acting = [name for name in self._parameters if not name.startswith("value_head")]

    @property
    def state_size(self) -> int:
        """See PolicyRuntime."""
        return self._network.state_size

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See PolicyRuntime. The value head may be absent: acting does not use it."""
        missing = [name for name in self._acting if name not in weights]
        if missing:
            raise PolicyError(f"the snapshot lacks the weights {missing[0]!r} of the network")
        for name, parameter in self._parameters.items():
            if name in weights and weights[name].shape != tuple(parameter.shape):
                raise PolicyError(
                    f"weights {name!r} are {weights[name].shape}, the network requires {tuple(parameter.shape)}"
                )
        for name, parameter in self._parameters.items():
            if name in weights:
                # Copied: torch requires writable memory, and a snapshot's arrays are read-only.
                parameter.copy_(torch.from_numpy(weights[name].copy()))

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: RandomSource | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PolicyRuntime."""
        output, next_state = self._network.act(torch.from_numpy(observations), torch.from_numpy(state))
        parameters, sampler = output.numpy(), self._sampler
        actions, log_probs = sampler.mode(parameters) if random is None else sampler.sample(parameters, random)
        return actions, log_probs, next_state.numpy() if self.state_size else state
