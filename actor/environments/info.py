"""What an actor reads of `info`: which discrete actions are legal, and the scalars at the end of an episode.

Environments say which actions are legal by one of the conventions that exist:
- `info["action_mask"]` (gymnasium): an array over all choices, a list or tuple of arrays whose choices together are
  these (as `sample(mask)` of gymnasium's spaces takes it), or a map of them by action component;
- `action_masks()` of the environment (stable-baselines3's contributors), which the gymnasium backend puts into `info`;
- a key `action_mask` of the observation (PettingZoo): an array over all choices, or a map of arrays by action
  component. The policy then does not observe it.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.environments.components import ObservationComponent
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.protocol.keys import is_name
from daedalus.protocol.spaces import ActionSpace, DiscreteSpace
from daedalus.protocol.spec import EnvironmentSpec
from daedalus.protocol.texts import bounded_text
from daedalus.protocol.uploads import LARGEST_EPISODE_NUMBER, MAX_INFO_NAMES, MAX_INFO_VALUES

MASK_KEY = "action_mask"


_NAME_OF_A_MASK = re.compile("mask|legal|valid|avail|allowed|feasible", re.IGNORECASE)


def unread_mask(values: Mapping[Any, Any], choices: int) -> str:
    """Return the name of an entry that seems to say which choices are legal, but is not read; empty if there is none.

    Args:
      values: `info` of one environment, or components of its observation.
      choices: number of choices of the action.
    """
    for name, value in values.items():
        if name == MASK_KEY or not isinstance(name, str) or not _NAME_OF_A_MASK.search(name):
            continue
        if not isinstance(value, np.ndarray | list | tuple | set | frozenset):
            continue
        try:
            array = np.asarray(value if isinstance(value, np.ndarray) else list(value))
        except ValueError:  # lists of different lengths
            continue
        if array.dtype.kind not in "biuf" or not array.size:
            continue
        flags = array.size == choices and bool(np.isin(array, (0, 1)).all())
        numbers = array.dtype.kind in "iu" and array.ndim == 1 and len(np.unique(array)) == array.size <= choices
        if flags or (numbers and array.min() >= 0 and array.max() < choices):
            return name
    return ""


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

    def allow(self, actions: Mapping[str, np.ndarray], masks: Mapping[str, np.ndarray]) -> bool:
        """Return whether masks {name: [1, choices]} allow an action, whose components are {name: [1, D]}."""
        for name, mask in masks.items():
            firsts = np.cumsum((0, *self._spaces[name].counts[:-1]))
            if not mask[0, firsts + actions[name][0]].all():
                return False
        return True

    def _by_component(self, action_mask: Any) -> dict[str, np.ndarray]:
        """Return masks {name: [E, choices]} bool from a map by component, or one array over all their choices."""
        if isinstance(action_mask, dict):
            parts = {name: _array(mask) for name, mask in masks_by_component(action_mask).items()}
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


def masks_by_component(action_mask: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the masks of a batch by component, without gymnasium's flags `_NAME` [E] beside each mask `NAME`.

    The name of a component may begin with `_`, too: any character that a name cannot have becomes one.
    """
    return {
        str(name): mask
        for name, mask in action_mask.items()
        if not (str(name)[:1] == "_" and str(name)[1:] in action_mask and np.ndim(mask) == 1)
    }


def _holds_mask(action_mask: Any) -> bool:
    """Return whether a batch of masks has any. gymnasium batches None of all environments as objects."""
    if isinstance(action_mask, dict):
        return any(_holds_mask(mask) for mask in masks_by_component(action_mask).values())
    if isinstance(action_mask, np.ndarray) and action_mask.dtype == np.object_:
        return any(mask is not None for mask in action_mask.flat)
    return action_mask is not None


def only_of_masks(action_mask: Any, row: int = 0) -> Any:
    """Return one mask, or map of masks, of a batch, of one by default."""
    if isinstance(action_mask, dict):
        return {name: mask[row] for name, mask in masks_by_component(action_mask).items()}
    return action_mask[row]


def mask_of_one(action_mask: Any) -> Any:
    """Return a mask, or a map of masks, with a first axis of 1."""
    if isinstance(action_mask, dict):
        return {name: _joined(mask)[None] for name, mask in action_mask.items()}
    return _joined(action_mask)[None]


def info_to_keep(info: dict[Any, Any], *, ended: bool) -> dict[str, Any]:
    """Return what an actor reads of the `info` of one environment: the masks, and the scalars if the episode ended.

    gymnasium cannot batch other entries, such as numbers that are beyond an int64 or texts in some environments only,
    and not every entry can leave the process of an environment.
    """
    kept: dict[str, Any] = {}
    if ended:
        for name, value in info.items():
            scalar = _scalar(value) if _is_scalars_name(name) else None
            if scalar is not None:
                kept[name] = scalar
    if MASK_KEY in info:
        kept[MASK_KEY] = info[MASK_KEY]
    return kept


def unreported(info: Any) -> str:
    """Return which numbers of the last `info` of an episode become no metrics, and why, or an empty string."""
    if not isinstance(info, Mapping):
        return ""
    scalars = [name for name, value in info.items() if isinstance(name, str) and _scalar(value) is not None]
    unfit = [name for name in scalars if not (name.startswith("_") or is_name(name))]
    if unfit:
        return (
            f"info has the number {bounded_text(unfit[0], 64)!r} at the end of an episode, which becomes no metric: "
            "name it with at most 64 letters, digits, '.', '_' and '-'"
        )
    fit = [name for name in scalars if _is_scalars_name(name)]
    if len(fit) > MAX_INFO_NAMES:
        return (
            f"info has {len(fit)} numbers at the end of an episode, and only {MAX_INFO_NAMES} become metrics: "
            f"{fit[MAX_INFO_NAMES]!r} does not"
        )
    return ""


def _is_scalars_name(name: Any) -> bool:
    return isinstance(name, str) and not name.startswith("_") and is_name(name)


def _scalar(value: Any) -> float | None:
    """Return a number or a bool as a float, or None for anything else."""
    if isinstance(value, np.ndarray) and value.shape == ():
        value = value[()]
    if not isinstance(value, (int, float, np.integer, np.floating, np.bool_)):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


class EpisodeInfo:
    """The scalars of the episodes that ended since the last `take`, by name.

    A scalar is a finite number or a bool under a name of 1 to 64 letters, digits, '.', '_' or '-'. Other entries of
    `info`, more than MAX_INFO_NAMES names and more than MAX_INFO_VALUES values of a name are left out.
    """

    def __init__(self) -> None:
        self._values: dict[str, list[float]] = {}

    def add(self, info: dict[str, Any], ended: np.ndarray) -> None:
        """Add the scalars of the last step of the episodes that ended with it.

        Args:
          info: of a gymnasium vector environment: `name` [E], and `_name` [E] bool where only some gave a value.
          ended: [E] bool.
        """
        if not ended.any():
            return
        for name, values in info.items():
            if not isinstance(values, np.ndarray) or values.shape != ended.shape or values.dtype.kind not in "biuf":
                continue
            known = name in self._values or len(self._values) < MAX_INFO_NAMES
            if not known or not _is_scalars_name(name):
                continue
            given = ended & np.asarray(info.get(f"_{name}", True), np.bool_)
            scalars = values[given].astype(np.float64)
            scalars = scalars[np.abs(scalars) <= LARGEST_EPISODE_NUMBER]  # not nan
            if len(scalars):
                kept = self._values.setdefault(name, [])
                kept.extend(scalars[: MAX_INFO_VALUES - len(kept)].tolist())

    def take(self) -> dict[str, np.ndarray]:
        """Return the scalars since the last call: name -> [n] float64, n at least 1."""
        values, self._values = self._values, {}
        return {name: np.array(kept, np.float64) for name, kept in values.items()}
