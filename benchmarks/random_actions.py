"""Random actions of any action space, for measurements without a policy."""

import numpy as np

from daedalus.protocol.spaces import DiscreteSpace, Spaces


def random_actions(spaces: Spaces, environments: int, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Return actions {name: [E, D]}, uniform over the choices, or between the bounds of continuous actions."""
    return {
        name: random.integers(0, space.counts, (environments, space.size))
        if isinstance(space, DiscreteSpace)
        else random.uniform(-1.0, 1.0, (environments, space.size)).astype(np.float32)
        for name, space in spaces.actions.items()
    }
