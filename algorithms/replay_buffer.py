"""Replay buffer: the newest transitions of all rollouts, for an algorithm that learns from each more than once.

State in main memory, and frames where they are asked for; no I/O, no threads.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from daedalus.policy.network.layers import Components
from daedalus.protocol.spaces import DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout

_DTYPES = {"float32": torch.float32, "uint8": torch.uint8, "uint16": torch.uint16}


class Transitions(NamedTuple):
    """B transitions, from the observation of a row to the one that its target bootstraps from."""

    observations: Components  # each [B, *stacked_shape]; discrete ones int64
    next_observations: Components  # the same
    actions: Tensor  # [B, D] float32, all components side by side; choices as numbers
    rewards: Tensor  # [B], the sum of the discounted rewards up to the next observation
    discounts: Tensor  # [B], of the value of the next observation; 0 after a termination


def joined(parts: Sequence[Transitions]) -> Transitions:
    """Return transitions one after the other."""
    if len(parts) == 1:
        return parts[0]
    return Transitions(
        observations={name: torch.cat([each.observations[name] for each in parts]) for name in parts[0].observations},
        next_observations={
            name: torch.cat([each.next_observations[name] for each in parts]) for name in parts[0].next_observations
        },
        actions=torch.cat([each.actions for each in parts]),
        rewards=torch.cat([each.rewards for each in parts]),
        discounts=torch.cat([each.discounts for each in parts]),
    )


class ReplayBuffer:
    """The newest columns of rollouts: T rows of one environment each, with the T+1 observations around them.

    A frame is stored once for its column, and stacked when it is sampled. The oldest column makes room for a new one,
    with all its rows. A transition does not go beyond its column: its target bootstraps at the last row at the latest.
    Neither does it go beyond the end of an episode, nor from the policy's rows into overridden ones or back: the target
    bootstraps there. Reset rows are never sampled, and overridden rows by `sample_taught` alone, if they teach.
    """

    def __init__(
        self, spaces: Spaces, rollout_length: int, capacity: int, device: Literal["cpu", "cuda"] = "cpu"
    ) -> None:
        """Allocate an empty buffer. The system gives main memory when it is first written to, and a GPU all at once.

        Args:
          spaces: components of observations and actions.
          rollout_length: T, rows of a column.
          capacity: rows, rounded up to columns.
          device: holds the frames, and those of a sample; the rest is in main memory.

        Raises torch.OutOfMemoryError if the device has no room for the frames.
        """
        self._rows, self.columns = rollout_length, -(-capacity // rollout_length)
        self._spaces, self._action_names = spaces.observations, tuple(spaces.actions)
        cells = (self.columns, rollout_length)
        # The first axis of all is that of the columns. Frames are bytes, for all data types: torch takes rows of them
        # several times faster than numpy.
        self._frames = {
            name: _zeros((self.columns, space.frames + rollout_length, space.frame_bytes), device)
            for name, space in spaces.observations.items()
        }
        self._arrays = {  # the rest of a column, by name
            "actions": np.zeros((*cells, sum(space.size for space in spaces.actions.values())), np.float32),
            "rewards": np.zeros(cells, np.float32),
            "terminated": np.zeros(cells, np.bool_),
            "ends": np.zeros(cells, np.bool_),  # the target of the row bootstraps from the next observation
            "learned": np.zeros(cells, np.bool_),
            "taught": np.zeros(cells, np.bool_),
            # Of each observation: how many frames before it are of its episode, at most those in a stack.
            "ages": np.zeros((self.columns, rollout_length + 1), np.uint8),
        }
        self._most_frames = max(space.frames for space in spaces.observations.values())
        self._queues = {name: _Rows(cells) for name in ("learned", "taught")}
        self.columns_added = 0  # ever

    @property
    def capacity(self) -> int:
        """Rows of all columns together."""
        return self.columns * self._rows

    @property
    def rows_added(self) -> int:
        """Rows to learn from that were ever added."""
        return self._queues["learned"].added

    def __len__(self) -> int:
        """Return the number of transitions that can be sampled."""
        return len(self._queues["learned"])

    @property
    def taught(self) -> int:
        """Number of transitions that `sample_taught` draws from."""
        return len(self._queues["taught"])

    def add(self, rollout: Rollout) -> None:
        """Add all columns of a rollout, or its last ones if it has more than the buffer."""
        ends = rollout.terminated | rollout.truncated  # [T, E]
        taught = np.zeros_like(ends) if rollout.taught is None else rollout.taught & rollout.valid
        ends[:-1] |= ~((rollout.learned[:-1] & rollout.learned[1:]) | (taught[:-1] & taught[1:]))
        rows = {
            **{f"frames/{name}": frames for name, frames in rollout.frames.items()},
            "actions": np.concatenate([rollout.actions[name] for name in self._action_names], -1),
            "rewards": rollout.rewards,
            "terminated": rollout.terminated,
            "ends": ends,
            "learned": rollout.learned,
            "taught": taught,
            "ages": self._ages_of(rollout.valid),
        }
        self.add_columns({name: values.swapaxes(0, 1) for name, values in rows.items()})

    def _ages_of(self, valid: np.ndarray) -> np.ndarray:
        """Return the ages [T+1, E] of the observations. The frames before row 0 are its complete stack."""
        ages = np.full((self._rows + 1, valid.shape[1]), self._most_frames - 1, np.uint8)
        for row in range(self._rows if self._most_frames > 1 else 0):
            ages[row + 1] = np.where(valid[row], np.minimum(ages[row] + 1, self._most_frames - 1), 0)
        return ages

    def add_columns(self, arrays: dict[str, np.ndarray]) -> None:
        """Add columns, or the last ones if they are more than the buffer has: each array [columns, ...] of `copied`."""
        arrays = {name: values[-self.columns :] for name, values in arrays.items()}
        at = (self.columns_added + np.arange(len(arrays["learned"]))) % self.columns
        for name, values in self._arrays.items():
            values[at] = arrays[name]
        for name, frames in self._frames.items():
            added = np.array(arrays[f"frames/{name}"], order="C").reshape(len(at), frames.shape[1], -1)
            frames[torch.from_numpy(at)] = torch.from_numpy(added.view(np.uint8)).to(frames.device)
        for name, queue in self._queues.items():
            queue.replace(at, arrays[name])
        self.columns_added += len(at)

    def copied(self, first: int, last: int) -> dict[str, np.ndarray]:
        """Return copies of the columns `first` to `last` - 1, counted over all that ever were added; each is held."""
        at = np.arange(first, last) % self.columns
        arrays = {name: values[at] for name, values in self._arrays.items()}
        for name, (shape, dtype) in self._shapes_of_frames().items():
            taken = self._frames[name][torch.from_numpy(at)].cpu().numpy()
            arrays[f"frames/{name}"] = taken.view(dtype).reshape(len(at), *shape)
        return arrays

    def shapes(self) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
        """Return shape and data type of each array of one column, by name."""
        frames = {f"frames/{name}": each for name, each in self._shapes_of_frames().items()}
        return frames | {name: (values.shape[1:], values.dtype) for name, values in self._arrays.items()}

    def _shapes_of_frames(self) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
        return {
            name: ((space.frames + self._rows, *space.shape), np.dtype(space.dtype))
            for name, space in self._spaces.items()
        }

    def sample(self, count: int, n_step: int, discount_factor: float) -> Transitions:
        """Return transitions of rows drawn uniformly, with torch's random numbers; the buffer is not empty.

        The target of row t has m rewards, at most `n_step`:

            rewards = sum_{i < m} discount_factor^i r_{t+i},  discounts = discount_factor^m (1 - terminated_{t+m-1})
        """
        return self.transitions(self._queues["learned"].drawn(count), n_step, discount_factor)

    def sample_taught(self, count: int, n_step: int, discount_factor: float) -> Transitions:
        """Return transitions of rows whose actions somebody else played, to learn from; as `sample`."""
        return self.transitions(self._queues["taught"].drawn(count), n_step, discount_factor)

    def transitions(self, indices: np.ndarray, n_step: int, discount_factor: float) -> Transitions:
        """Return the transitions of some rows, [B] indices of those in `learned_rows`; for the rest see `sample`."""
        columns, rows = np.divmod(indices, self._rows)
        flat = {name: self._arrays[name].ravel() for name in ("rewards", "terminated", "ends")}
        rewards, discounts = np.zeros(len(rows), np.float32), np.ones(len(rows), np.float32)
        following, goes_on = rows.copy(), np.ones(len(rows), np.bool_)
        for _ in range(n_step):
            at = columns * self._rows + np.minimum(following, self._rows - 1)
            rewards += np.where(goes_on, discounts * flat["rewards"][at], 0.0)
            discounts *= np.where(goes_on, np.where(flat["terminated"][at], 0.0, discount_factor), 1.0)
            following += goes_on
            goes_on &= ~flat["ends"][at] & (following < self._rows)
        return Transitions(
            observations=self._observations(columns, rows),
            next_observations=self._observations(columns, following),
            actions=torch.from_numpy(self._arrays["actions"][columns, rows]),
            rewards=torch.from_numpy(rewards),
            discounts=torch.from_numpy(discounts),
        )

    @property
    def nbytes(self) -> int:
        """Main memory that the full buffer takes, in bytes."""
        held = [frames.nbytes for frames in self._frames.values() if frames.device.type == "cpu"]
        held += [values.nbytes for values in self._arrays.values()]
        return sum(held) + 8 * self.capacity  # and the queue of its rows

    @property
    def learned_rows(self) -> np.ndarray:
        """Indices of all rows that can be sampled, oldest first."""
        return self._queues["learned"].rows

    def _observations(self, columns: np.ndarray, rows: np.ndarray) -> Components:
        """Return the observations of rows, with their stacks."""
        found: Components = {}
        for name, space in self._spaces.items():
            frames, depth = self._frames[name], space.frames
            newest = columns * frames.shape[1] + rows + (depth - 1)
            if depth > 1:
                # The first frame of an episode replaces those before it: see protocol/frames.py.
                back = np.minimum(np.arange(depth - 1, -1, -1), self._arrays["ages"][columns, rows][:, None])  # [B, k]
                newest = newest[:, None] - back
            at = torch.from_numpy(newest.ravel()).to(frames.device)
            taken = frames.flatten(0, 1).index_select(0, at).view(_DTYPES[space.dtype])
            values = taken.view(*newest.shape, *space.shape)
            found[name] = values.long() if isinstance(space, DiscreteSpace) else values
        return found


def _zeros(shape: tuple[int, ...], device: str) -> Tensor:
    """Return bytes. In main memory they are numpy's, to which the system gives no memory before they are written."""
    if device == "cpu":
        return torch.from_numpy(np.zeros(shape, np.uint8))
    return torch.zeros(shape, dtype=torch.uint8, device=device)


class _Rows:
    """Rows of one kind, oldest first, by index: columns come and go in order, and with them their rows."""

    def __init__(self, cells: tuple[int, int]) -> None:
        """`cells`: columns and rows of the buffer. The system gives the memory when it is first written to."""
        columns, self._length = cells
        self._queue = np.zeros(columns * self._length, np.int64)
        self._first = self.added = 0  # counted over all rows that ever were in it
        self._counts = np.zeros(columns, np.int64)  # in each column

    def __len__(self) -> int:
        return self.added - self._first

    def replace(self, at: np.ndarray, chosen: np.ndarray) -> None:
        """Replace the rows of some columns by those that are chosen, [columns, T] bool."""
        self._first += int(self._counts[at].sum())
        self._counts[at] = chosen.sum(1)
        places, rows = np.nonzero(chosen)
        self._queue[(self.added + np.arange(len(rows))) % len(self._queue)] = at[places] * self._length + rows
        self.added += len(rows)

    def drawn(self, count: int) -> np.ndarray:
        """Return rows that are drawn uniformly, with torch's random numbers."""
        return self._queue[(self._first + torch.randint(len(self), (count,)).numpy()) % len(self._queue)]

    @property
    def rows(self) -> np.ndarray:
        return self._queue[np.arange(self._first, self.added) % len(self._queue)]
