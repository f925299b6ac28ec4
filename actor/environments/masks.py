"""Which discrete actions are legal, as environments say it by the conventions that exist.

- `info["action_mask"]` (gymnasium): an array over all choices, a list or tuple of arrays whose choices together are
  these (as `sample(mask)` of gymnasium's spaces takes it), or a map of them by action component;
- `action_masks()` of the environment (stable-baselines3's contributors), which the gymnasium backend puts into `info`;
- a key `action_mask` of the observation (PettingZoo): an array over all choices, or a map of arrays by action
  component. The policy then does not observe it.
"""

from collections.abc import Callable, Iterable
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.environments.components import ObservationComponent
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.protocol.spaces import ActionSpace, DiscreteSpace
from daedalus.protocol.spec import EnvironmentSpec

MASK_KEY = "action_mask"


def has_choices(action_space: gymnasium.Space, spec: EnvironmentSpec) -> bool:
    """Return whether the actions of a run may have masks: they are not all continuous."""
    return not isinstance(action_space, gymnasium.spaces.Box) or spec.action_table is not None


class Masks:
    """The masks of an environment's actions. `spaces` are the action's components, those with masks marked."""

    def __init__(self, spaces: dict[str, ActionSpace], example: Any) -> None:
        """Construct from one batch of masks, or None if the environment has no masks.

        Raises EnvironmentSetupError if it does not fit the actions.
        """
        self._spaces = {name: space for name, space in spaces.items() if isinstance(space, DiscreteSpace)}
        masked = set(self._by_component(example)) if example is not None else set()
        self._names = tuple(name for name in spaces if name in masked)
        self.spaces: dict[str, ActionSpace] = {
            name: space.model_copy(update={"masked": True}) if name in masked else space
            for name, space in spaces.items()
        }

    def __call__(self, action_mask: Any, needed: np.ndarray) -> dict[str, np.ndarray]:
        """Return the masks {name: [E, choices]} bool; see Transforms.observe."""
        if not self._names:
            if self._spaces and _holds_mask(action_mask):
                raise EnvironmentSetupError(
                    f"info has an {MASK_KEY} after a step, but reset gave none: give it in reset too"
                )
            return {}
        if action_mask is None:
            raise EnvironmentSetupError(f"the environment's info has no {MASK_KEY!r} any more: give it in every step")
        given = self._by_component(action_mask)
        for name in given.keys() - set(self._names):
            raise EnvironmentSetupError(
                f"the {MASK_KEY} has an entry for {name!r} after a step, but reset gave none: give it in reset too"
            )
        return {name: self._checked(name, given.get(name), needed) for name in self._names}

    def _by_component(self, action_mask: Any) -> dict[str, np.ndarray]:
        """Return masks {name: [E, choices]} bool from a map by component, or one array over all their choices."""
        if isinstance(action_mask, dict):
            parts = {str(name): _array(mask) for name, mask in action_mask.items() if str(name)[:1] != "_"}
        elif len(self._spaces) == 1:
            parts = {next(iter(self._spaces)): _array(action_mask)}
        else:
            parts = self._split(_array(action_mask))
        return {name: _flags(name, mask, self._spaces.get(name)) for name, mask in parts.items()}

    def _split(self, masks: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parts of one array over the choices of several components, or of none."""
        sizes = [space.choices for space in self._spaces.values()]
        if masks.ndim != 2 or masks.shape[1] != sum(sizes):
            raise EnvironmentSetupError(
                f"the {MASK_KEY} has shape {masks.shape[1:]}, but the discrete components of the action have "
                f"{' + '.join(map(str, sizes)) or 'no'} choices: give a map of one mask for each"
            )
        return dict(zip(self._spaces, np.split(masks, np.cumsum(sizes)[:-1], axis=1), strict=True))

    def _checked(self, name: str, mask: np.ndarray | None, needed: np.ndarray) -> np.ndarray:
        if mask is None:
            raise EnvironmentSetupError(f"the {MASK_KEY} has no entry for {name!r} any more: give it in every step")
        first = 0
        for variable, count in enumerate(self._spaces[name].counts):
            forbidden = ~mask[:, first : first + count].any(axis=1)  # [E]
            if (forbidden & needed).any():
                environment = int(np.flatnonzero(forbidden & needed)[0])
                raise EnvironmentSetupError(
                    f"the {MASK_KEY} of {name!r} forbids every choice of variable {variable} in environment "
                    f"{environment}: one must be legal while an episode goes on"
                )
            if forbidden.any():  # no action is taken from here, but probabilities must be defined
                mask = mask.copy()
                mask[forbidden, first : first + count] = True
            first += count
        return mask


class ObservedMasks:
    """The masks that are components of the observation; none if the actions have no choices."""

    def __init__(self, components: Iterable[ObservationComponent], actions: dict[str, ActionSpace]) -> None:
        """Find the masks. Raises EnvironmentSetupError for one that does not fit the actions."""
        discrete = {name: space for name, space in actions.items() if isinstance(space, DiscreteSpace)}
        self._components = [each for each in components if discrete and each.leaf.path[:1] == (MASK_KEY,)]
        for component in self._components:
            name = _action_of(component)
            choices = sum(space.choices for key, space in discrete.items() if name in ("", key))
            if component.first is not None or component.shape != (choices,) or not choices:
                raise EnvironmentSetupError(
                    f"observation component {component.leaf.name!r} has shape {component.shape}, and is no mask of the "
                    f"action's discrete components, {', '.join(map(repr, discrete))}: give an array over all their "
                    "choices or a map of arrays, or leave the component out: "
                    f"--set \"environment.leave_out=['{component.leaf.name}']\""
                )

    def __bool__(self) -> bool:
        return bool(self._components)

    def contains(self, component: ObservationComponent) -> bool:
        """Return whether a component of the observation is a mask."""
        return any(component is mask for mask in self._components)

    @property
    def example(self) -> Any:
        """Masks of a batch of one, in which every choice is legal; see `of`."""
        return self._masks(lambda component: np.ones((1, *component.shape), np.bool_))

    def of(self, observations: Any) -> Any:
        """Return the masks of batched observations: one array over all choices, or a map by action component."""
        return self._masks(lambda component: component.values(observations))

    def _masks(self, mask: Callable[[ObservationComponent], np.ndarray]) -> Any:
        masks = {_action_of(component): mask(component) for component in self._components}
        return masks.get("", masks)


def _action_of(component: ObservationComponent) -> str:
    """Return the action component that an observed mask is for; empty for all."""
    return component.leaf.name.removeprefix(MASK_KEY).removeprefix(".")


def _flags(name: str, mask: np.ndarray, space: DiscreteSpace | None) -> np.ndarray:
    if space is None:
        raise EnvironmentSetupError(f"the {MASK_KEY} names {name!r}, which is no discrete component of the action")
    flat = mask.reshape(len(mask), -1) if mask.ndim else mask
    if flat.ndim != 2 or flat.shape[1] != space.choices or flat.dtype.kind not in "biuf":
        raise EnvironmentSetupError(
            f"the {MASK_KEY} of {name!r} has shape {mask.shape[1:]}, but the action has {space.choices} choices"
        )
    legal = flat.astype(np.bool_)
    if flat.dtype.kind != "b" and (other := legal != flat).any():  # such as -inf for an illegal choice
        raise EnvironmentSetupError(
            f"the {MASK_KEY} of {name!r} has the value {flat[other][0]:g}: write 1 for each legal choice, 0 for others"
        )
    return legal


def _array(masks: Any) -> np.ndarray:
    """Return a batch of masks as one array [E, ...]. gymnasium batches lists and tuples as objects."""
    array = masks if isinstance(masks, np.ndarray) else np.asarray(masks)
    if array.dtype != np.object_:
        return array
    rows = [_joined(mask) for mask in array]
    if len({len(row) for row in rows}) != 1:
        raise EnvironmentSetupError(f"the {MASK_KEY} differs in size between environments: give it in every step")
    return np.stack(rows)


def _joined(mask: Any) -> np.ndarray:
    """Return one mask [choices] for an array, or for lists and tuples of arrays, nested in any way."""
    if isinstance(mask, list | tuple):
        parts = [_joined(part) for part in mask if part is not None]  # None stands for a component without choices
        return np.concatenate(parts) if parts else np.zeros(0, np.bool_)
    return np.asarray(mask).ravel()


def _holds_mask(action_mask: Any) -> bool:
    """Return whether a batch of masks has any. gymnasium batches None of all environments as objects."""
    if isinstance(action_mask, dict):
        return any(_holds_mask(mask) for name, mask in action_mask.items() if str(name)[:1] != "_")
    if isinstance(action_mask, np.ndarray) and action_mask.dtype == np.object_:
        return any(mask is not None for mask in action_mask.flat)
    return action_mask is not None


def only_of_masks(action_mask: Any) -> Any:
    """Return the only mask, or map of masks, of a batch of one."""
    if isinstance(action_mask, dict):
        return {name: mask[0] for name, mask in action_mask.items()}
    return action_mask[0]


def mask_of_one(action_mask: Any) -> Any:
    """Return a mask, or a map of masks, with a first axis of 1."""
    if isinstance(action_mask, dict):
        return {name: _joined(mask)[None] for name, mask in action_mask.items()}
    return _joined(action_mask)[None]
