"""PolicyRuntime over the torch network itself, for actors that have torch anyway (`--runtime torch`)."""

import numpy as np
import torch

from daedalus.policy.acting.runtime import PolicyError
from daedalus.policy.acting.sampling import greedy_categorical, sample_categorical
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.errors import NetworkError
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec


class TorchRuntime:
    """Runs the network with torch on one thread."""

    def __init__(self, spec: PolicySpec, spaces: Spaces) -> None:
        """Raises PolicyError if this network cannot be built, or may not be built here."""
        if ":" in spec.encoder:
            # The name came over the wire; importing it would execute what somebody else chose.
            raise PolicyError(f"the encoder {spec.encoder!r} is the user's own: use --runtime onnx")
        torch.set_num_threads(1)
        try:
            self._network = ActorCritic(spec, spaces).eval().requires_grad_(False)
        except NetworkError as error:
            raise PolicyError(str(error)) from None
        self._parameters = dict(self._network.named_parameters())
        self._acting = [name for name in self._parameters if not name.startswith("value_head")]

    @property
    def state_size(self) -> int:
        """See PolicyRuntime."""
        return self._network.state_size

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See PolicyRuntime. The value head plays no part in acting and may be absent."""
        missing = [name for name in self._acting if name not in weights]
        if missing:
            raise PolicyError(f"the snapshot lacks the weights {missing[0]!r} of the network")
        for name, parameter in self._parameters.items():
            if name in weights and weights[name].shape != tuple(parameter.shape):
                raise PolicyError(
                    f"weights {name!r} are {weights[name].shape}, the network wants {tuple(parameter.shape)}"
                )
        for name, parameter in self._parameters.items():
            if name in weights:
                # Copied: torch wants memory that it may write to, and a snapshot's is read-only.
                parameter.copy_(torch.from_numpy(weights[name].copy()))

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: np.random.Generator | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PolicyRuntime."""
        logits, next_state = self._network.act(torch.from_numpy(observations), torch.from_numpy(state))
        choose = logits.numpy()
        actions, log_probs = greedy_categorical(choose) if random is None else sample_categorical(choose, random)
        return actions, log_probs, next_state.numpy() if self.state_size else state
