"""Demonstrations in the learner: a buffer of their transitions, and behaviour cloning."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from daedalus.algorithms.forward import FlatParameters, Forward
from daedalus.algorithms.replay_buffer import ReplayBuffer, Transitions
from daedalus.learner.run.demonstration_files import DemonstrationFiles, check_memory
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.layers import map_components
from daedalus.protocol.spaces import DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec

_logger = logging.getLogger(__name__)


def read_demonstrations(
    directory: Path, spec: RunSpec, spaces: Spaces, taken: int, beat: Callable[[], None] = lambda: None
) -> ReplayBuffer | None:
    """Return the demonstrations of a run directory, or None if it has none.

    Args:
      directory: of the run.
      spec: of the run.
      spaces: of the run.
      taken: bytes that the learner's replay buffer may take.
      beat: called before each part is read.

    Raises DamagedError, or SettingsError if they do not fit into memory, or not the run.
    """
    files = DemonstrationFiles(directory)
    if not files.steps:
        return None
    check_memory(files.steps, files.columns * spaces.replay_bytes(files.rows), taken)
    buffer = ReplayBuffer(spaces, files.rows, files.columns * files.rows)
    for rollout in files.rollouts(spaces, spec.policy):
        beat()
        buffer.add(rollout)
    _logger.info("demonstrations: %s steps of %s", f"{files.steps:,}", files.dataset)
    return buffer


_HELD_OUT = 0.1  # share of the steps, the last ones, that the cloning before training does not learn from
_MOST_HELD_OUT = 4096
_MOMENTS_ROWS = 65_536  # that statistics of observations begin with
_MINIBATCH = 256


class Cloning:
    """Behaviour cloning: the policy ascends the mean log-probability of the actions of demonstrations.

    Attributes:
      weight: of the cloning term in the loss of each update.
    """

    weight = 0.0

    def __init__(
        self,
        network: ActorCritic,
        learned: FlatParameters,
        forward: Forward,
        spaces: Spaces,
        demonstrations: ReplayBuffer,
    ) -> None:
        """Construct for a network without memory.

        Args:
          network: whose policy is cloned.
          learned: its parameters that have gradients.
          forward: the network.
          spaces: of the run.
          demonstrations: not empty.
        """
        self._network, self._learned, self._forward = network, learned, forward
        self._spaces, self._buffer = spaces, demonstrations
        rows = demonstrations.learned_rows
        kept = max(len(rows) - min(int(_HELD_OUT * len(rows)), _MOST_HELD_OUT), 1)
        self._rows, self._held_out = rows[:kept], rows[kept:]

    def observations(self) -> Iterator[dict[str, Tensor]]:
        """Yield observations of the demonstrations, by component [N, *stacked_shape]: at most 65,536 in small parts."""
        rows = self._rows[:: -(-len(self._rows) // _MOMENTS_ROWS)]
        for part in _parts(rows):
            yield self._buffer.transitions(part, 1, 1.0).observations

    def gradient(self) -> Tensor:
        """Return the gradient [P] of minus the mean log-probability, over a minibatch drawn at random."""
        drawn = self._rows[torch.randint(len(self._rows), (_MINIBATCH,)).numpy()]
        return self._learned.differentiated(-self._log_probs(drawn).mean())

    def held_out(self) -> float:
        """Return the mean log-probability of actions that are not learned from before training; nan without any."""
        if not len(self._held_out):
            return np.nan
        with torch.no_grad():
            parts = [self._log_probs(rows) for rows in _parts(self._held_out)]
        return float(torch.cat(parts, -1).mean())

    def _log_probs(self, rows: np.ndarray) -> Tensor:
        device = self._learned.values.device
        shown: Transitions = self._buffer.transitions(rows, 1, 1.0)
        observations = map_components(shown.observations, lambda values: values.to(device)[None])
        starts = torch.zeros((1, len(rows)), dtype=torch.bool, device=device)
        state = torch.zeros((len(rows), 0), device=device)
        parameters, _ = self._forward(self._network.prepare(observations), state, starts)
        sizes = [space.size for space in self._spaces.actions.values()]
        parts = shown.actions.to(device)[None].split(sizes, -1)
        actions = {
            name: part.long() if isinstance(space, DiscreteSpace) else part
            for (name, space), part in zip(self._spaces.actions.items(), parts, strict=True)
        }
        return self._network.distribution.log_prob(parameters, actions, {})


def _parts(rows: np.ndarray) -> list[np.ndarray]:
    return np.array_split(rows, -(-len(rows) // _MINIBATCH))
