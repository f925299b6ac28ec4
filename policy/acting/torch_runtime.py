"""PolicyRuntime that runs the torch network itself, for actors that have torch installed (`--runtime torch`)."""

from collections.abc import Iterable, Mapping

import numpy as np
import torch

from daedalus.policy.acting.noise import Noise, NoiseSize, no_exploration
from daedalus.policy.acting.runtime import Choice, PolicyError
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_modules import NetworkError
from daedalus.protocol.spaces import DiscreteSpace, Spaces
from daedalus.protocol.spec import LossSpec, PolicySpec


def load_weights(
    weights: Mapping[str, np.ndarray], parameters: Mapping[str, torch.Tensor], needed: Iterable[str]
) -> None:
    """Copy a snapshot's weights into parameters, of which only those that are `needed` must be in it.

    Raises PolicyError if they do not fit; nothing has changed then.
    """
    missing = [name for name in needed if name not in weights]
    if missing:
        raise PolicyError(f"the snapshot lacks the weights {missing[0]!r} of the network")
    given = {name: (weights[name], parameter) for name, parameter in parameters.items() if name in weights}
    for name, (values, parameter) in given.items():
        if values.shape != tuple(parameter.shape):
            raise PolicyError(f"weights {name!r} are {values.shape}, the network requires {tuple(parameter.shape)}")
    with torch.no_grad():
        for values, parameter in given.values():
            # Copied: torch requires writable memory, and a snapshot's arrays are read-only.
            parameter.copy_(torch.from_numpy(values.copy()))


class TorchRuntime:
    """Runs the network with torch, on one thread of the CPU by default."""

    def __init__(
        self,
        spec: PolicySpec,
        spaces: Spaces,
        training: LossSpec | None = None,
        *,
        device: str = "cpu",
        threads: int = 1,
    ) -> None:
        """Raise PolicyError if the network cannot be built, has code that the user supplies, or there is no `device`.

        `training` is as for ActorCritic.
        """
        if device == "cuda" and not torch.cuda.is_available():
            raise PolicyError(f"torch {torch.__version__} finds no GPU here: use --inference shared")
        for name in (spec.encoder, spec.distribution):
            if ":" in name:
                # The name came over the wire; importing it would execute code that another process chose.
                raise PolicyError(
                    f"{name!r} is custom code, not imported here: use --runtime onnx, and not --inference cuda"
                )
        torch.set_num_threads(threads)
        self._device = device
        try:
            network = ActorCritic(spec, spaces, training=training)
            self._network = network.to(device).eval().requires_grad_(False)
        except NetworkError as error:
            raise PolicyError(str(error)) from None
        self._noise_size = NoiseSize(self._network.uniform_count, self._network.distribution.normal_count)
        self._discrete = {name for name, space in spaces.observations.items() if isinstance(space, DiscreteSpace)}
        self._parameters = dict(self._network.named_parameters())
        self._acting = [name for name in self._parameters if not name.startswith("value_")]

    @property
    def state_size(self) -> int:
        """See PolicyRuntime."""
        return self._network.state_size

    @property
    def noise_size(self) -> NoiseSize:
        """See PolicyRuntime."""
        return self._noise_size

    @property
    def explores(self) -> bool:
        """See PolicyRuntime."""
        return self._network.exploration is not None

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See PolicyRuntime. The value head and its encoder may be absent: acting does not use them."""
        load_weights(weights, self._parameters, self._acting)

    def act(
        self,
        observations: dict[str, np.ndarray],
        state: np.ndarray,
        noise: Noise,
        masks: dict[str, np.ndarray],
        epsilon: np.ndarray | None = None,
    ) -> Choice:
        """See PolicyRuntime."""
        tensors = {
            name: self._tensor(values.astype(np.int64) if name in self._discrete else values)
            for name, values in observations.items()
        }
        actions, log_probs, next_state = self._network.act(
            tensors,
            self._tensor(state),
            self._tensor(noise.uniform),
            self._tensor(noise.normal),
            {name: self._tensor(mask) for name, mask in masks.items()},
            self._tensor(no_exploration(len(state)) if epsilon is None else epsilon),
        )
        chosen = {name: values.cpu().numpy() for name, values in actions.items()}
        return Choice(chosen, log_probs.cpu().numpy(), next_state.cpu().numpy() if self.state_size else state)

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(self._device)
