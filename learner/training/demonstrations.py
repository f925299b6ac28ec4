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
_SEQUENCES, _SEQUENCE_ROWS = 8, 64  # of a minibatch for a policy with memory


class Cloning:
    """Behaviour cloning: the policy ascends the mean log-probability of the actions of demonstrations.

    A policy without memory learns from steps that are drawn at random. One with memory goes through the episodes from
    their beginnings, and its state is carried from one minibatch to the next: truncated backpropagation through time.
    After a resume, the sequences begin anew.

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
        """Construct for a network.

        Args:
          network: whose policy is cloned.
          learned: its parameters that have gradients.
          forward: the network.
          spaces: of the run.
          demonstrations: not empty; its episodes stand one after the other, with a row between two of them.
        """
        self._network, self._learned, self._forward = network, learned, forward
        self._spaces, self._buffer = spaces, demonstrations
        self._all_rows = rows = demonstrations.learned_rows
        self._kept = max(len(rows) - min(int(_HELD_OUT * len(rows)), _MOST_HELD_OUT), 1)
        self._rows = rows[: self._kept]
        self._sequences = _Sequences(self._rows) if network.state_size else None
        self._state = learned.values.new_zeros((_SEQUENCES, network.state_size))

    def observations(self) -> Iterator[dict[str, Tensor]]:
        """Yield observations of the demonstrations, by component [N, *stacked_shape]: at most 65,536 in small parts."""
        rows = self._rows[:: -(-len(self._rows) // _MOMENTS_ROWS)]
        for part in _parts(rows):
            yield self._buffer.transitions(part, 1, 1.0).observations

    def gradient(self) -> Tensor:
        """Return the gradient [P] of minus the mean log-probability, over the next minibatch."""
        if self._sequences is None:
            drawn = self._rows[torch.randint(len(self._rows), (1, _MINIBATCH)).numpy()]
            log_probs, _ = self._log_probs(
                drawn, np.zeros(drawn.shape, np.bool_), self._state.new_zeros((_MINIBATCH, 0))
            )
        else:
            log_probs, state = self._log_probs(*self._sequences.next_rows(), self._state)
            self._state = state.detach()
        return self._learned.differentiated(-log_probs.mean())

    def held_out(self) -> float:
        """Return the mean log-probability of actions that are not learned from before training; nan without any.

        The memory begins with the episode of the first one, or 4,096 steps before.
        """
        rows, first = self._all_rows, self._kept
        if first == len(rows):
            return np.nan
        if self._sequences is not None:
            begun = np.flatnonzero(_begins(rows[: first + 1]))[-1]
            first = max(int(begun), first - _MOST_HELD_OUT)
        state, found = self._state.new_zeros((1, self._network.state_size)), []
        with torch.no_grad():
            for part, begins in zip(_parts(rows[first:]), _parts(_begins(rows)[first:]), strict=True):
                log_probs, state = self._log_probs(part[:, None], begins[:, None], state)
                found.append(log_probs)
        return float(torch.cat(found)[self._kept - first :].mean())

    def _log_probs(self, rows: np.ndarray, begins: np.ndarray, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-probabilities [R, B] of the actions of rows, and the state of the policy after them [B, S].

        Args:
          rows: [R, B] of the buffer.
          begins: [R, B] bool, whether an episode begins with the row.
          state: [B, S] before row 0.
        """
        device = state.device
        shown: Transitions = self._buffer.transitions(rows.ravel(), 1, 1.0)
        observations = map_components(shown.observations, lambda values: values.to(device).unflatten(0, rows.shape))
        starts = torch.from_numpy(begins).to(device)
        parameters, state = self._forward.policy(self._network.prepare(observations), state, starts)
        sizes = [space.size for space in self._spaces.actions.values()]
        parts = shown.actions.to(device).unflatten(0, rows.shape).split(sizes, -1)
        actions = {
            name: part.long() if isinstance(space, DiscreteSpace) else part
            for (name, space), part in zip(self._spaces.actions.items(), parts, strict=True)
        }
        legal = {name: starts.new_ones((*rows.shape, choices)) for name, choices in self._spaces.masks.items()}
        return self._network.distribution.log_prob(parameters, actions, legal), state


class _Sequences:
    """Sequences of steps, which go through whole episodes in random order; each episode is used before any again."""

    def __init__(self, rows: np.ndarray) -> None:
        """`rows` are those of the episodes, in order."""
        self._firsts = rows[begins := _begins(rows)]
        self._episodes = np.split(rows, np.flatnonzero(begins)[1:])
        self._order: list[int] = []
        self._left = [rows[:0]] * _SEQUENCES  # of each sequence: the rows that come next

    def next_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the next rows of all sequences [R, B], and whether an episode begins with each."""
        for sequence, left in enumerate(self._left):
            parts, count = [left], len(left)
            while count < _SEQUENCE_ROWS:
                self._order = self._order or torch.randperm(len(self._episodes)).tolist()
                parts.append(self._episodes[self._order.pop()])
                count += len(parts[-1])
            self._left[sequence] = np.concatenate(parts)
        rows = np.stack([left[:_SEQUENCE_ROWS] for left in self._left], 1)
        self._left = [left[_SEQUENCE_ROWS:] for left in self._left]
        return rows, np.isin(rows, self._firsts)


def _begins(rows: np.ndarray) -> np.ndarray:
    """Return whether an episode begins with each row: the row before is not learned from."""
    return np.diff(rows, prepend=-2) != 1


def _parts(rows: np.ndarray) -> list[np.ndarray]:
    return np.array_split(rows, -(-len(rows) // _MINIBATCH))
