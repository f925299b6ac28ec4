"""The transforms of a specification, applied to a backend's environments: components, action table, pixels, masks."""

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from pydantic import ValidationError

from daedalus.actor.environments.components import (
    ActionComponents,
    BoundedActions,
    LeftOut,
    ObservationComponent,
    batch_of_one,
    continuous_space,
    exported_dtype,
    leaves,
    observation_components,
    only_of_batch,
    without,
)
from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described, reason_of
from daedalus.actor.environments.games import GameEnvironments
from daedalus.actor.environments.gymnasium_environments import GymnasiumEnvironments
from daedalus.actor.environments.info import MASK_KEY, Masks, ObservedMasks, mask_of_one
from daedalus.actor.environments.pixels import Pixels
from daedalus.actor.environments.vector_environments import BackendEnvironments, Observed, Step
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.spaces import ActionSpace, ArraySpace, DiscreteSpace, ObservationSpaces, Spaces, unfit_number
from daedalus.protocol.spec import EnvironmentSpec

if TYPE_CHECKING:
    from daedalus.policy.saving.onnx_graph import OnnxGraph

_CHOICE, _REST = "table", "continuous"  # components of an action of which the table gives a part


class TableActions:
    """The actions of a Box by an action table: a choice of a row, and the numbers that the table leaves to the policy.

    With a table over all numbers the run has one discrete action, `action`. Else it has two components: `table`, the
    row, and `continuous`, the other numbers in their order.
    """

    def __init__(
        self, table: tuple[tuple[float, ...], ...], columns: tuple[int, ...] | None, space: gymnasium.Space
    ) -> None:
        """Construct the mapping.

        Args:
          table: one row of numbers for each choice.
          columns: which numbers of the flattened action a row gives; None: all, in their order.
          space: of the environment's actions.

        Raises EnvironmentSetupError if the table does not fit the space.
        """
        if not isinstance(space, gymnasium.spaces.Box):
            raise EnvironmentSetupError(
                f"environment.action_table has {len(table)} rows, but action space {described(space)} needs no table: "
                "leave it out"
            )
        size = int(np.prod(space.shape))
        self._columns = np.arange(size) if columns is None else _checked_columns(columns, space, size)
        self._rest = np.setdiff1d(np.arange(size), self._columns)
        self._table = _checked_table(table, self._columns, space)
        self._space = space
        rest_space = gymnasium.spaces.Box(
            space.low.ravel()[self._rest],
            space.high.ravel()[self._rest],
            dtype=space.dtype,  # pyright: ignore[reportArgumentType]  # gymnasium's annotation lacks np.dtype
        )
        self._rest_actions = BoundedActions(rest_space)
        choice = DiscreteSpace(counts=(len(table),))
        self.spaces: dict[str, ActionSpace] = {"action": choice}
        if self._rest.size:
            self.spaces = {_REST: continuous_space(rest_space), _CHOICE: choice}

    def env_actions(self, values: dict[str, np.ndarray]) -> Any:
        """Return the environment's batched actions for values {name: [E, D]} of all components."""
        if not self._rest.size:
            chosen = self._table[values["action"][:, 0]]
            return chosen.reshape(len(chosen), *self._space.shape)
        actions = np.empty((len(values[_CHOICE]), self._columns.size + self._rest.size), self._space.dtype)
        actions[:, self._columns] = self._table[values[_CHOICE][:, 0]]
        actions[:, self._rest] = self._rest_actions.of(values[_REST])
        return actions.reshape(len(actions), *self._space.shape)

    def policy_actions(self, actions: Any) -> dict[str, np.ndarray]:
        """Return the values {name: [E, D]} of the environment's batched actions: the inverse of `env_actions`.

        Raises ValueError for an action outside the space, or of which the table has no row.
        """
        flat = np.asarray(actions).reshape(len(actions), -1)
        differences = np.abs(flat[:, None, self._columns].astype(np.float64) - self._table.astype(np.float64))
        unequal = differences.max(-1) > 1e-6 * (1.0 + np.abs(self._table).max(-1))  # [E, choices]
        if (missing := unequal.all(1)).any():
            raise ValueError(f"environment.action_table has no row for the action {described(flat[missing][0])}")
        choices = (~unequal).argmax(1)[:, None].astype(self.spaces[_CHOICE if self._rest.size else "action"].dtype)
        if not self._rest.size:
            return {"action": choices}
        return {_CHOICE: choices, _REST: self._rest_actions.values(flat[:, self._rest])}

    def add_outputs(self, graph: "OnnxGraph", values: Mapping[str, str]) -> None:
        """Add what `env_actions` does to an ONNX graph: the output `action`."""
        choice = graph.reshaped(values[_CHOICE if self._rest.size else "action"], ())
        actions = graph.add("Gather", graph.constant(self._table), choice, axis=0)
        if self._rest.size:
            actions = graph.add("Concat", actions, self._rest_actions.exported(graph, values[_REST]), axis=1)
            order = np.argsort(np.concatenate([self._columns, self._rest]))
            actions = graph.add("Gather", actions, graph.constant(order, np.int64), axis=1)
        dtype = exported_dtype(self._space)
        graph.output("action", graph.cast(actions, dtype), dtype, self._space.shape)


def _checked_columns(columns: tuple[int, ...], space: gymnasium.spaces.Box, size: int) -> np.ndarray:
    if len(set(columns)) < len(columns):
        raise EnvironmentSetupError(f"environment.action_table_columns names a number twice: {list(columns)}")
    if max(columns) >= size:
        raise EnvironmentSetupError(
            f"environment.action_table_columns names number {max(columns)}, but an action of space {described(space)} "
            f"has the numbers 0 to {size - 1}"
        )
    return np.asarray(columns)


def _checked_table(
    table: tuple[tuple[float, ...], ...], columns: np.ndarray, space: gymnasium.spaces.Box
) -> np.ndarray:
    """Return the rows of the table [count, len(columns)], in the order and the dtype of the action's numbers."""
    low, high = space.low.ravel()[columns], space.high.ravel()[columns]
    of_integers = space.dtype is not None and space.dtype.kind != "f"
    for number, row in enumerate(table):
        if len(row) != columns.size:
            few = columns.size < space.low.size
            expected = "action_table_columns names" if few else f"an action of space {described(space)} has"
            raise EnvironmentSetupError(
                f"environment.action_table row {number} has {len(row)} numbers, but {expected} {columns.size}"
            )
        # In the space's own precision, in which a bound such as 0.7 is another number; integers would be truncated.
        action = np.asarray(row, np.float64 if of_integers else space.dtype)
        if not ((action >= low) & (action <= high)).all():
            raise EnvironmentSetupError(
                f"environment.action_table row {number} is {row}, outside action space {described(space)}"
            )
        if of_integers and (action != np.rint(action)).any():
            raise EnvironmentSetupError(
                f"environment.action_table row {number} is {row}, but action space {described(space)} has integers"
            )
    return np.asarray(table, space.dtype)


_logger = logging.getLogger(__name__)


class Transforms:
    """The mapping between an environment's spaces and the run's.

    `spaces` are the run's: flat maps of components, after the action table and the pixel transforms.
    """

    def __init__(
        self,
        spec: EnvironmentSpec,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        action_mask: Any = None,
    ) -> None:
        """Construct the mapping.

        Args:
          spec: the transforms.
          observation_space, action_space: of one environment.
          action_mask: the mask that accompanied a batch of observations; None if the environment has no masks.

        Raises EnvironmentSetupError if the specification does not fit the spaces.
        """
        observation_space = without(observation_space, spec.leave_out)
        self._observation_space, self._action_space = observation_space, action_space
        self._actions = _actions(spec, action_space)
        components = observation_components(observation_space)
        self._observed_masks = ObservedMasks(components, self._actions.spaces)
        self._observations = [each for each in components if not self._observed_masks.contains(each)]
        if not self._observations:
            raise EnvironmentSetupError(
                f"observation space {described(observation_space)} has nothing but the {MASK_KEY}"
            )
        example = self._observed_masks.example if self._observed_masks else action_mask
        self._masks = Masks(self._actions.spaces, example)
        self._pixels = _pixels(spec, self._observations)
        try:
            self.spaces = Spaces(
                observations=_observation_spaces(spec, self._observations, self._pixels),
                actions=self._masks.spaces,
            )
        except ValidationError as error:
            raise EnvironmentSetupError(
                f"observation space {described(observation_space)} with action space {described(action_space)} is not "
                f"supported: {reason_of(error)}"
            ) from None

    @property
    def needs_mask(self) -> bool:
        """Whether `observe` needs an action mask: the actions have masks, and the observation does not contain them."""
        return bool(self.spaces.masks) and not self._observed_masks

    @property
    def first_choices(self) -> dict[str, tuple[int, ...]]:
        """First choice of each variable of the components that do not count from 0 as the run does: by their names."""
        starts = {f"observation {each.leaf.name}": each.first for each in self._observations if each.first is not None}
        if isinstance(self._actions, ActionComponents):
            starts |= {f"action {name}": first for name, first in self._actions.first_choices.items()}
        return {name: tuple(first.tolist()) for name, first in starts.items() if first.any()}

    def observe(self, observations: Any, action_mask: Any, needed: np.ndarray) -> Observed:
        """Return batched observations of the environment as the run has them.

        Args:
          observations: of the environment's own space, each component with a first axis E.
          action_mask: as BackendEnvironments has it.
          needed: [E] bool, whether an action will be taken from the observation: then a choice must be legal.

        Raises EnvironmentSetupError for a mask that forbids every choice where one is needed, or of a wrong size, and
        for observations of another shape or dtype than their space.
        """
        frames = {}
        for component in self._observations:
            values, pixels = component.values(observations), self._pixels.get(component.leaf.name)
            if len(values) != len(needed):
                raise EnvironmentSetupError(
                    f"the environment returned {len(values)} observations of {component.leaf.name!r} for "
                    f"{len(needed)} environments"
                )
            frames[component.leaf.name] = values if pixels is None else pixels(values)
        if self._observed_masks:
            action_mask = self._observed_masks.of(observations)
        return Observed(frames, self._masks(action_mask, needed))

    def observe_one(self, observation: Any, action_mask: Any, needed: bool = True) -> Observed:
        """Return one observation of the environment's own space as the run has it, with E = 1.

        Args:
          observation: one observation; it is checked.
          action_mask: the legal choices, one array or a map of them by action component; None without masks.
          needed: whether an action will be taken from it.

        Raises ValueError if the observation or the mask does not fit the spaces, or no policy can act on it.
        """
        batch = batch_of_one(self._observation_space, observation)
        mask = None if action_mask is None else mask_of_one(action_mask)
        try:
            observed = self.observe(batch, mask, np.array([needed]))
        except EnvironmentSetupError as error:
            raise ValueError(str(error)) from None
        for name, frames in observed.frames.items():
            if unfit := unfit_number(frames):
                raise ValueError(f"component {name!r} of the observation {unfit}")
        return observed

    def add_inputs(self, graph: "OnnxGraph") -> tuple[dict[str, str], dict[str, str]]:
        """Add what `observe` and the frame stacks do to an ONNX graph. Return values of observations and masks.

        The inputs have the names of the components. A mask is the input action_mask, or action_mask.NAME where the
        action has several components, also if the observation contains it.
        """
        values = {}
        for component in self._observations:
            name, frames = component.leaf.name, component.add_input(graph)
            if name in self._pixels:
                frames = self._pixels[name].exported(graph, frames)
            space = self.spaces.observations[name]
            if isinstance(space, ArraySpace) and space.frames > 1:
                dtype = np.uint8 if space.dtype == "uint8" else np.float32
                frames = graph.stacked(name, frames, space.shape, dtype, space.frames)
            values[name] = frames
        masks = {
            name: graph.input(self.mask_input(name), np.bool_, (size,)) for name, size in self.spaces.masks.items()
        }
        return values, masks

    def mask_input(self, action: str) -> str:
        """Return the input of the mask of an action component; see add_inputs."""
        return MASK_KEY if len(self.spaces.actions) == 1 else f"{MASK_KEY}.{action}"

    def add_outputs(self, graph: "OnnxGraph", values: dict[str, str]) -> None:
        """Add what `env_actions` does to an ONNX graph, for values of the run's actions."""
        self._actions.add_outputs(graph, values)

    def env_actions(self, actions: dict[str, np.ndarray]) -> Any:
        """Return the environment's batched actions for the run's {name: [E, D]}."""
        return self._actions.env_actions(actions)

    def policy_actions(self, actions: Any) -> dict[str, np.ndarray]:
        """Return the run's actions {name: [E, D]} for the environment's batched actions: `env_actions` inverted.

        Raises ValueError for an action outside its space.
        """
        return self._actions.policy_actions(actions)

    def policy_action(self, action: Any) -> dict[str, np.ndarray]:
        """Return the run's actions {name: [1, D]} for one action of the environment. Raises as `policy_actions`."""
        return self._actions.policy_actions(batch_of_one(self._action_space, action, "the action"))

    def env_action(self, actions: dict[str, np.ndarray]) -> Any:
        """Return the environment's action for the run's {name: [1, D]}."""
        return only_of_batch(self._action_space, self._actions.env_actions(actions))


class LegalRepeats:
    """Whether an action is still legal after a step of one environment, which may show another mask."""

    def __init__(
        self, spec: EnvironmentSpec, observation_space: gymnasium.Space, action_space: gymnasium.Space
    ) -> None:
        """Construct from the transforms, and the spaces of the environment, some of whose actions are choices.

        Raises EnvironmentSetupError for spaces that do not fit the transforms, as Transforms does.
        """
        self._action_space, self._actions = action_space, _actions(spec, action_space)
        seen = without(observation_space, spec.leave_out)
        parts = seen.spaces if isinstance(seen, gymnasium.spaces.Dict) else {}
        # Nothing else is read here: whoever makes the environment may leave out a text of it later.
        self._mask_space = gymnasium.spaces.Dict({MASK_KEY: parts.get(MASK_KEY, LeftOut())})
        is_read = any(not isinstance(leaf.space, LeftOut) for leaf in leaves(self._mask_space, MASK_KEY))
        components = observation_components(self._mask_space) if is_read else ()
        self._observed_masks = ObservedMasks(components, self._actions.spaces)
        self._masks: Masks | None = None  # known with the first one

    def __call__(self, action: Any, observation: Any, info: Mapping[str, Any]) -> bool:
        """Return whether `action` may be taken again, after a step that returned `observation` and `info`.

        Where nothing is legal there is nothing to choose, and the action goes on. Raises EnvironmentSetupError for a
        mask that does not fit.
        """
        mask = info.get(MASK_KEY)
        if self._observed_masks:
            mask = self._observed_masks.of(batch_of_one(self._mask_space, observation))
        elif mask is not None:
            mask = mask_of_one(mask)
        if mask is None:
            return True
        if self._masks is None:
            self._masks = Masks(self._actions.spaces, mask)
        values = self._actions.policy_actions(batch_of_one(self._action_space, action, "the action"))
        return self._masks.allow(values, self._masks(mask, np.zeros(1, np.bool_)))


class TransformedEnvironment:
    """A VectorEnvironment: a backend's environments with the specification's transforms."""

    def __init__(self, environments: BackendEnvironments, spec: EnvironmentSpec, *, one_episode: bool = False) -> None:
        """Raises EnvironmentSetupError if the specification does not fit the environments.

        For `one_episode` see make_environments.
        """
        self._environments = environments
        self._games = environments if isinstance(environments, GameEnvironments) else None
        self._name, self._one_episode = spec.id, one_episode
        self._ended = np.zeros(environments.count, np.bool_)  # [E] whether the next step only resets
        self._warned_of_rewards = False
        self._over = np.zeros(environments.count, np.bool_)  # [E] whether the only episode of each has ended
        self._transforms = Transforms(
            spec, environments.observation_space, environments.action_space, environments.action_mask
        )

    @property
    def count(self) -> int:
        """See VectorEnvironment."""
        return self._environments.count

    @property
    def spaces(self) -> Spaces:
        """See VectorEnvironment."""
        return self._transforms.spaces

    @property
    def games(self) -> GameEnvironments | None:
        """See VectorEnvironment."""
        return self._games

    @property
    def seats(self) -> int:
        """See VectorEnvironment."""
        return self._games.seats if self._games is not None else 1

    def reset(self, seed: int) -> Observed:
        """See VectorEnvironment."""
        observations = self._environments.reset(seed)
        self._over, self._ended = np.zeros((2, self.count), np.bool_)
        needed = np.ones(self.count, np.bool_) if self._games is None else self._games.acting
        observed = self._transforms.observe(observations, self._environments.action_mask, needed)
        return observed if self._games is None else observed._replace(acting=self._games.acting, over=self._games.over)

    def step(self, actions: dict[str, np.ndarray]) -> Step:
        """See VectorEnvironment."""
        observations, rewards, terminated, truncated = self._environments.step(self._transforms.env_actions(actions))
        ended = terminated | truncated
        if self._games is not None:
            acting = self._games.acting
            observed = self._transforms.observe(observations, self._games.action_mask, acting & ~ended)
            return observed._replace(acting=acting, over=self._games.over), rewards, terminated, truncated
        if np.count_nonzero(self._ended):  # a tenth of the time of any()
            rewards = self._rewards_of_steps(rewards, ended)
        self._ended = ended
        if self._one_episode:
            ended = self._over = self._over | ended
        needed = ~ended  # after an episode's end the next step only resets, or the environment stands still
        observed = self._transforms.observe(observations, self._environments.action_mask, needed)
        return observed, rewards, terminated, truncated

    def _rewards_of_steps(self, rewards: np.ndarray, ended: np.ndarray) -> np.ndarray:
        """Return the rewards [E] without those of environments that only reset in this step: no action earned them.

        Raises EnvironmentSetupError if an episode ends there. The next step of that environment would be a reset by its
        own account and a real one by ours.
        """
        resets = self._ended
        if np.count_nonzero(ended & resets):
            number = np.flatnonzero(ended & resets)[0]
            raise EnvironmentSetupError(
                f"environment {self._name}: environment {number} ends an episode in the step "
                "after an episode's end, which only resets (AutoresetMode.NEXT_STEP): return terminated and truncated "
                "False there"
            )
        if not self._warned_of_rewards and len(ignored := rewards[resets & (rewards != 0.0)]):
            self._warned_of_rewards = True
            _logger.warning(
                "environment %s: it gives the reward %g in a step that only resets after an episode's end "
                "(AutoresetMode.NEXT_STEP): such rewards are ignored; return 0 there, or the last reward with the end",
                self._name,
                ignored[0],
            )
        return np.where(resets, 0.0, rewards)

    def set_parameters(self, parameters: Mapping[int, Parameters]) -> None:
        """See VectorEnvironment."""
        assert isinstance(self._environments, GymnasiumEnvironments)  # no other backend has parameters
        self._environments.set_parameters(parameters)

    @property
    def agents(self) -> tuple[str, ...]:
        """The agents of the seats of each game; empty if there are no games."""
        return () if self._games is None else self._games.agents

    @property
    def action_names(self) -> tuple[str, ...]:
        """What the environment calls its choices; empty if it does not say."""
        return getattr(self._environments, "action_names", ())

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """See VectorEnvironment."""
        return self._environments.take_episode_info()

    def close(self) -> None:
        """See VectorEnvironment."""
        self._environments.close()


def _actions(spec: EnvironmentSpec, space: gymnasium.Space) -> ActionComponents | TableActions:
    if spec.action_table is not None:
        return TableActions(spec.action_table, spec.action_table_columns, space)
    if spec.action_table_columns is not None:
        raise EnvironmentSetupError("environment.action_table_columns needs environment.action_table: set it, too")
    return ActionComponents(space)


def _pixels(spec: EnvironmentSpec, components: list[ObservationComponent]) -> dict[str, Pixels]:
    """Return the pixel transforms of each image; of the only component whatever it is, so that a misfit is reported."""
    if spec.crop is None and not spec.grey and spec.resize is None:
        return {}
    images = [component for component in components if _is_image(component)] if len(components) > 1 else components
    if not images:
        raise EnvironmentSetupError(
            "environment.crop, grey and resize need an image, but the observation has none: leave them out"
        )
    return {component.leaf.name: Pixels(spec, _box(component)) for component in images}


def _is_image(component: ObservationComponent) -> bool:
    space = component.leaf.space
    if not isinstance(space, gymnasium.spaces.Box) or space.dtype != np.uint8:
        return False
    return ArraySpace(shape=component.shape, dtype="uint8").is_image


def _box(component: ObservationComponent) -> gymnasium.spaces.Box:
    space = component.leaf.space
    if not isinstance(space, gymnasium.spaces.Box):
        raise EnvironmentSetupError(
            f"environment.crop, grey and resize do not fit observation space {described(space)}"
        )
    return space


def _observation_spaces(
    spec: EnvironmentSpec, components: list[ObservationComponent], pixels: dict[str, Pixels]
) -> ObservationSpaces:
    spaces: ObservationSpaces = {}
    for component in components:
        name = component.leaf.name
        if component.first is not None:
            spaces[name] = DiscreteSpace(counts=component.counts)
        else:
            shape = pixels[name].shape if name in pixels else component.shape
            dtype = "uint8" if component.leaf.space.dtype == np.uint8 else "float32"
            spaces[name] = ArraySpace(shape=shape, dtype=dtype)
    depths = _stack_depths(spec, spaces)
    return {
        name: space.model_copy(update={"frames": depths[name]}) if isinstance(space, ArraySpace) else space
        for name, space in spaces.items()
    }


def _stack_depths(spec: EnvironmentSpec, spaces: ObservationSpaces) -> dict[str, int]:
    """Return the depth of the frame stack of each component."""
    arrays = {name: space for name, space in spaces.items() if isinstance(space, ArraySpace)}
    depth = spec.frame_stack
    if isinstance(depth, dict):
        unknown = [name for name in depth if name not in arrays]
        if unknown:
            raise EnvironmentSetupError(
                f"environment.frame_stack names {unknown[0]!r}, but the arrays of the observation are "
                f"{', '.join(arrays) or 'none'}"
            )
        return {name: depth.get(name, 1) for name in arrays}
    if depth > 1 and not arrays:
        raise EnvironmentSetupError(
            f"environment.frame_stack is {depth}, but the observation has no array to stack: leave it out"
        )
    images = {name for name, space in arrays.items() if space.is_image}
    return {name: depth if name in (images or arrays) else 1 for name in arrays}
