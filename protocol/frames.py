"""Frames and frame stacks. A frame is sent once; the actor and the learner build the same stacks from the frames.

A stack is the newest k frames, oldest first. At the start of an episode its first frame replaces the frames before it,
so no stack contains frames of two episodes. The actor keeps running stacks; the learner builds the stacks of every row
of a rollout from the received frames. Pure numpy; codec.py encodes frames as bytes.
"""

import numpy as np

from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces


class FrameStack:
    """Running stacks of E environments. With k = 1 a stack is the frame itself, without a stack axis."""

    def __init__(self, space: ArraySpace | DiscreteSpace, environments: int) -> None:
        self._depth = space.frames
        self._frames = np.zeros((environments, space.frames, *space.shape), space.dtype)

    @property
    def frames(self) -> np.ndarray:
        """Frames of the stacks [E, k, *frame_shape], also for k = 1; a view."""
        return self._frames

    @property
    def observations(self) -> np.ndarray:
        """Observations of the policy [E, *stacked_shape]; a view, valid until the next `push`."""
        return self._frames[:, 0] if self._depth == 1 else self._frames

    def push(self, frames: np.ndarray, starts: np.ndarray, where: np.ndarray | slice = slice(None)) -> None:
        """Add the next frame of each environment.

        Args:
          frames: [E, *frame_shape].
          starts: [E] bool, whether an episode starts with the frame.
          where: [E] bool, the environments that have a next frame, if not all.
        """
        if self._depth == 1:
            self._frames[where, 0] = frames[where]
            return
        self._frames[where, :-1] = self._frames[where, 1:]
        self._frames[where, -1] = frames[where]
        for environment in np.flatnonzero(starts):
            self._frames[environment] = frames[environment]


class ObservationStacks:
    """Running stacks of every component of the observations of E environments."""

    def __init__(self, spaces: Spaces, environments: int) -> None:
        self._stacks = {name: FrameStack(space, environments) for name, space in spaces.observations.items()}

    @property
    def frames(self) -> dict[str, np.ndarray]:
        """Frames of the stacks of each component [E, k, *frame_shape]; views."""
        return {name: stack.frames for name, stack in self._stacks.items()}

    @property
    def observations(self) -> dict[str, np.ndarray]:
        """Observations of the policy, each [E, *stacked_shape]; views, valid until the next `push`."""
        return {name: stack.observations for name, stack in self._stacks.items()}

    def push(self, frames: dict[str, np.ndarray], starts: np.ndarray, where: np.ndarray | slice = slice(None)) -> None:
        """Add the next frame of each component and environment; arguments as for FrameStack."""
        for name, stack in self._stacks.items():
            stack.push(frames[name], starts, where)
