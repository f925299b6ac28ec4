"""Random legal actions of any action space. No threads."""

import numpy as np

from daedalus.protocol.spaces import ActionSpace, ContinuousSpace, DiscreteSpace


class RandomActions:
    """A policy that draws every action at random from those that are legal."""

    def __init__(self, spaces: dict[str, ActionSpace], seed: int) -> None:
        self._spaces = spaces
        self._random = np.random.default_rng(seed)

    def choose(self, masks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return actions {name: [1, D]}, given the masks {name: [1, choices]} of the components that have masks."""
        return {name: self._values(space, masks.get(name))[None] for name, space in self._spaces.items()}

    def _values(self, space: ActionSpace, mask: np.ndarray | None) -> np.ndarray:
        match space:
            case DiscreteSpace():
                legal = np.ones(space.choices, np.bool_) if mask is None else mask[0]
                parts = np.split(legal, np.cumsum(space.counts)[:-1])
                return np.array([self._random.choice(np.flatnonzero(part)) for part in parts])
            case ContinuousSpace():
                bounded = [None not in bounds for bounds in zip(space.low, space.high, strict=True)]
                uniform, normal = self._random.uniform(-1.0, 1.0, space.size), self._random.standard_normal(space.size)
                return np.where(bounded, uniform, normal).astype(np.float32)
