"""Nested spaces of gymnasium as flat lists of named leaves. Pure functions.

A leaf is named by the keys and indices that lead to it, joined by dots; a space that is not composite has the name
`observation` or `action`.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described

_LONGEST_NAME = 64  # ComponentName of the protocol


class Leaf(NamedTuple):
    """A space that is not composite, and where it is in the nested space."""

    name: str
    path: tuple[str | int, ...]
    space: gymnasium.Space

    def of(self, value: Any) -> np.ndarray:
        """Return this component of a nested value; in a batch each component has the first axis E."""
        for key in self.path:
            value = value[key]
        return np.asarray(value)


def leaves(space: gymnasium.Space, whole: str) -> tuple[Leaf, ...]:
    """Return all leaves of a nested space, in gymnasium's order. `whole` is the name of a space that is not composite.

    Of leaves that would have the same name, as keys in Chinese may, the second is numbered 2, and so on. Raises
    EnvironmentSetupError if there are none.
    """
    found: dict[str, Leaf] = {}
    for path, leaf in _walk(space, ()):
        name = _unused(_name(path) if path else whole, found)
        found[name] = Leaf(name, path, leaf)
    if not found:
        raise EnvironmentSetupError(f"{whole} space {described(space)} is empty: it must have at least one component")
    return tuple(found.values())


def _walk(space: gymnasium.Space, path: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    if isinstance(space, gym.Dict):
        for key, part in space.spaces.items():
            yield from _walk(part, (*path, key))
    elif isinstance(space, gym.Tuple):
        for index, part in enumerate(space.spaces):
            yield from _walk(part, (*path, index))
    else:
        yield path, space


def _name(path: tuple[str | int, ...]) -> str:
    """Return the keys in the letters that a name may have, joined by dots: the last 64, which tell most."""
    return ".".join(re.sub(r"[^\w-]", "_", str(key), flags=re.ASCII) or "_" for key in path)[-_LONGEST_NAME:]


def _unused(name: str, used: Collection[str]) -> str:
    """Return a name that is not used yet, with a number at its end if need be."""
    unused, number = name, 1
    while unused in used:
        number += 1
        ending = f"_{number}"
        unused = name[: _LONGEST_NAME - len(ending)] + ending
    return unused


class LeftOut(gymnasium.Space):
    """The place of a component that the policy does not see."""


def without(space: gymnasium.Space, names: Sequence[str]) -> gymnasium.Space:
    """Return an observation space whose components of these names are LeftOut.

    Raises EnvironmentSetupError for a name that is no component.
    """
    if not names:
        return space
    components = {leaf.name: leaf.path for leaf in leaves(space, "observation")}
    unknown = [name for name in names if name not in components]
    if unknown:
        raise EnvironmentSetupError(
            f"environment.leave_out names {unknown[0]!r}, but the components of the observation are "
            f"{', '.join(components)}"
        )
    return _without(space, (), {components[name] for name in names})


def _without(space: Any, path: tuple[str | int, ...], paths: Collection[tuple[str | int, ...]]) -> gymnasium.Space:
    if path in paths:
        return LeftOut()
    if isinstance(space, gym.Dict):
        return gym.Dict({key: _without(part, (*path, key), paths) for key, part in space.spaces.items()})
    if isinstance(space, gym.Tuple):
        return gym.Tuple([_without(part, (*path, index), paths) for index, part in enumerate(space.spaces)])
    return space
