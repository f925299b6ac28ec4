"""Frames and the stacks made of them. A frame travels once; both ends make the same stacks of it.

A stack is the newest k frames, oldest first. At the start of an episode its first frame stands in for the frames
before it, so no stack shows two episodes. The actor keeps running stacks; the learner makes those of every row of a
rollout from the frames that came. Pure numpy; this file does not know how frames become bytes (codec.py).
"""

import numpy as np

from daedalus.protocol.spaces import ArraySpace


class FrameStack:
    """The running stacks of E environments. With k = 1 a stack is the frame itself, without an axis of its own."""

    def __init__(self, space: ArraySpace, environments: int) -> None:
        self._depth = space.frames
        self._frames = np.zeros((environments, space.frames, *space.shape), space.dtype)

    @property
    def frames(self) -> np.ndarray:
        """[E, k, *frame_shape] what the stacks are made of, also where k is 1; a view."""
        return self._frames

    @property
    def observations(self) -> np.ndarray:
        """[E, *stacked_shape] what the policy sees; a view, good until the next `push`."""
        return self._frames[:, 0] if self._depth == 1 else self._frames

    def push(self, frames: np.ndarray, starts: np.ndarray) -> None:
        """Takes in the next frame of each environment.

        Args:
          frames: [E, *frame_shape].
          starts: [E] bool, whether an episode starts with it.
        """
        if self._depth == 1:
            self._frames[:, 0] = frames
            return
        self._frames[:, :-1] = self._frames[:, 1:]
        self._frames[:, -1] = frames
        for environment in np.flatnonzero(starts):
            self._frames[environment] = frames[environment]


def stack_rows(frames: np.ndarray, valid: np.ndarray, out: np.ndarray) -> None:
    """Makes the observations of all rows of a rollout.

    Args:
      frames: [k-1 + T+1, E, *frame_shape]; the first k are the stack of row 0, complete as it was.
      valid: [T, E] bool; after a row that is not, an episode starts.
      out: [T+1, E, k, *frame_shape], to be filled; k is taken from it.
    """
    rows, depth = out.shape[0], out.shape[2]
    for age in range(depth):
        out[:, :, age] = frames[age : age + rows]
    for row, environment in np.argwhere(~valid):
        start = row + 1  # the first row of the new episode
        first = frames[start + depth - 1, environment]
        for later in range(start, min(start + depth - 1, rows)):
            # Of this row's stack, frames from before the start are those at the first depth - 1 - (later - start).
            out[later, environment, : depth - 1 - (later - start)] = first
