"""What observations are besides their spaces: texts, codes, maps. What a seed decides. And gymnasium's own checker."""

import copy
import functools
import importlib
import re
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing, suppress
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

from daedalus.actor.environments.bots import RandomActions
from daedalus.actor.environments.components import is_text, leaves, numbered, without
from daedalus.actor.environments.environment_errors import EnvironmentSetupError, creation_errors
from daedalus.actor.environments.games import GameEnvironments, make_games
from daedalus.actor.environments.gymnasium_backend import make_single, registration
from daedalus.actor.environments.info import MASK_KEY, has_choices, mask_of_one, unread_mask
from daedalus.actor.environments.transforms import TransformedEnvironment, Transforms
from daedalus.policy.user_code import first_line
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import Spaces, unfit_code
from daedalus.protocol.spec import EnvironmentSpec

_RESETS, _SECONDS = 20, 2.0  # the most resets, and the time for those after the second
_SHOWN = 60  # characters of a text in a message


class Texts:
    """The texts of one environment, and whether they change."""

    def __init__(self, space: gymnasium.Space, leave_out: tuple[str, ...]) -> None:
        """Construct from the observation space, and the names of the components that nobody reads."""
        found = leaves(space, "observation")
        self._leaves = [leaf for leaf in found if leaf.path and is_text(leaf.space) and leaf.name not in leave_out]
        self._seen: dict[str, list[str]] = {leaf.name: [] for leaf in self._leaves}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the components that are texts."""
        return tuple(self._seen)

    @property
    def constant(self) -> dict[str, str]:
        """The texts that never changed, by component."""
        return {name: seen[0] for name, seen in self._seen.items() if len(seen) == 1}

    @property
    def problem(self) -> str:
        """A description of the first text that changes, or an empty string."""
        for name, seen in self._seen.items():
            if len(seen) > 1:
                return (
                    f"observation component {name!r} is a text that changes ({_shown(seen[0])}, {_shown(seen[1])}): "
                    "make numbers of it with --wrap MODULE:FUNCTION, or leave it out if the policy does not need it: "
                    f"--set \"environment.leave_out=['{name}']\""
                )
        return ""

    def watch(self, environment: gymnasium.Env, seed: int) -> None:
        """Reset the environment several times: a text may be another in each episode."""
        until = time.monotonic() + _SECONDS
        with suppress(Exception, SystemExit):  # of the user's code; playing reports it
            for episode in range(_RESETS if self._leaves else 0):
                self.add(environment.reset(seed=seed + episode)[0])
                if episode > 0 and time.monotonic() > until:
                    return

    def add(self, observation: Any) -> None:
        """Take note of the texts of an observation."""
        for leaf in self._leaves:
            text, seen = str(leaf.of(observation)), self._seen[leaf.name]
            if text not in seen and len(seen) < 2:
                seen.append(text)


_MINIGRID = "minigrid.minigrid_env"  # module of the class of all its environments
_CODE_CHANNELS = ("OBJECT_TO_IDX", "COLOR_TO_IDX", "STATE_TO_IDX")  # tables of the kinds, colours and states
_DIRECTIONS = 4  # which are the states of an agent


def minigrid_codes(environment: gymnasium.Env, space: gymnasium.Space, seed: int) -> dict[str, tuple[int, ...]]:
    """Return the components of MiniGrid's observations that are codes, with the number of codes of each channel.

    They are declared as bytes from 0 to 255, as its pictures and any picture are. So the class of the environment
    tells, and its first observation: a picture of a maze has no values as low as codes. The numbers are those of the
    installed release, with kinds of things that the user has added.
    """
    if not any(each.__module__ == _MINIGRID for each in type(environment.unwrapped).__mro__):
        return {}
    constants = importlib.import_module("minigrid.core.constants")
    kinds, colours, states = (max(getattr(constants, table).values()) + 1 for table in _CODE_CHANNELS)
    codes = (kinds, colours, max(states, _DIRECTIONS))
    with suppress(Exception, SystemExit):  # of the user's code; playing reports it
        observation = environment.reset(seed=seed)[0]
        return {
            leaf.name: codes
            for leaf in leaves(space, "observation")
            if leaf.space.dtype == np.uint8
            and len(shape := leaf.space.shape or ()) == 3
            and shape[2] == len(codes)
            and not unfit_code(leaf.of(observation), codes)
        }
    return {}


_SMALLEST_MAP, _LARGEST_MAP = 8, 32  # cells of a side


def square_maps(space: gymnasium.Space) -> tuple[str, ...]:
    """Return the components that are maps (height, width, planes) of a few cells by their space: square, of 0 and 1."""
    return tuple(
        leaf.name
        for leaf in leaves(space, "observation")
        if isinstance(leaf.space, gymnasium.spaces.Box | gymnasium.spaces.MultiBinary)
        and len(shape := leaf.space.shape or ()) == 3
        and _SMALLEST_MAP <= shape[0] == shape[1] <= _LARGEST_MAP
        and (leaf.space.dtype == np.bool_ or _is_binary(leaf.space))
    )


def _is_binary(space: gymnasium.Space) -> bool:
    if isinstance(space, gymnasium.spaces.Box):
        return space.dtype.kind in "iu" and bool((space.low == 0).all() and (space.high == 1).all())
    return True  # MultiBinary


def _shown(text: str) -> str:
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


_FIRST_STEPS = 20  # of an episode, which two environments with one seed play


def seed_warnings(spec: EnvironmentSpec, modules: UserModules, seconds: float) -> tuple[str, ...]:
    """Return what is wrong with how an environment uses its seed, as far as it is known within about 3 x `seconds`.

    Args:
      spec: the environment or game, and its transforms, without texts in its observations.
      modules: the modules that may be imported for it.
      seconds: for each part.
    """
    found = list[str]()
    with suppress(Exception, SystemExit):  # of the user's code; playing reports it
        make = partial(make_games, spec, 1) if spec.is_game else partial(make_single, spec)
        environment, until = make(modules), time.monotonic() + seconds
        if environment is None:
            return ()
        with closing(environment):
            first = _first_rows(environment, spec)
            is_known = time.monotonic() < until
            is_repeated = is_known and _alike(first, _first_rows(environment, spec))
            found.append(_fixed_start(environment, spec, seconds))
        if is_repeated:  # else gymnasium's checker says so
            with closing(make(modules)) as environment:  # pyright: ignore[reportArgumentType]  # the first was made
                found.append(_own_task(first, _first_rows(environment, spec), spec))
    return tuple(filter(None, found))


def _own_task(rows: list[np.ndarray], others: list[np.ndarray], spec: EnvironmentSpec) -> str:
    """Return a warning if two environments with one seed play differently, though each repeats its own episode."""
    if _alike(rows, others):
        return ""
    return (
        f"environment {spec.id}: two of them with the same seed play differently, though each repeats its own "
        "episode: its constructor draws what the seed does not decide, so that every environment of training "
        "and of evaluations has a task of its own; draw it in reset, from "
        f"{'a generator with its seed' if spec.is_game else 'self.np_random'}"
    )


_SEEDS, _UNSEEDED = 3, 10  # resets; a chance of two starts repeats one so often once in a thousand environments


def _fixed_start(environment: gymnasium.Env | GameEnvironments, spec: EnvironmentSpec, seconds: float) -> str:
    """Return a warning if resets without a seed all begin alike, though the seed changes how an episode begins.

    Only the first episode of an environment has a seed in training, as usual; in evaluations each has one.
    """
    begin, until = _beginning(environment, spec), time.monotonic() + seconds
    starts = list[list[np.ndarray]]()
    for number in range(_SEEDS + _UNSEEDED):
        if time.monotonic() > until:
            return ""
        starts.append(begin(number if number < _SEEDS else None))
        if number == _SEEDS - 1 and all(_equal(each, starts[0]) for each in starts):
            return ""  # the same with every seed
        if number > _SEEDS and not _equal(starts[number], starts[_SEEDS]):
            return ""
    return (
        f"environment {spec.id}: all episodes that reset begins without a seed begin alike, but those with seeds "
        "differ: training gives a seed to the first episode of each environment only, and so plays one start, "
        "while evaluations play others; seed the generator of random numbers only where reset gets a seed"
    )


def _beginning(
    environment: gymnasium.Env | GameEnvironments, spec: EnvironmentSpec
) -> Callable[[int | None], list[np.ndarray]]:
    """Return a function that resets an environment with a seed or None, and returns the first observation."""
    space = without(environment.observation_space, spec.leave_out)
    read = [leaf for leaf in leaves(space, "observation") if leaf.space.shape is not None]

    def shown(observations: Iterable[Any]) -> list[np.ndarray]:
        return [leaf.of(each).copy() for each in observations for leaf in read]

    if isinstance(environment, GameEnvironments):
        (copy,) = environment.copies_for()
        seen = partial(numbered, number=0) if spec.agent_ids else lambda observation: observation
        return lambda seed: shown(seen(outcome.observation) for outcome in copy.reset(seed))
    return lambda seed: shown([environment.reset(seed=seed)[0]])


def _equal(start: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return len(start) == len(other) and all(map(np.array_equal, start, other))


def _first_rows_of_seats(games: GameEnvironments, spec: EnvironmentSpec) -> list[np.ndarray]:
    """Return the observations, rewards and ends of the seats that act in the first steps of a match."""
    environments, rows = TransformedEnvironment(games, spec), list[np.ndarray]()
    random, observed = RandomActions(environments.spaces.actions, 0), environments.reset(0)
    for _ in range(_FIRST_STEPS):
        rows += [frames[observed.acting].copy() for frames in observed.frames.values()]
        if games.is_over(0):
            break
        observed, *outcomes = environments.step(random.choose_each(observed.masks, games.count))
        rows += [values[observed.acting] for values in outcomes]
    return rows


def _first_rows(environment: gymnasium.Env | GameEnvironments, spec: EnvironmentSpec) -> list[np.ndarray]:
    """Return the observations, rewards and ends of the first steps of an episode."""
    if isinstance(environment, GameEnvironments):
        return _first_rows_of_seats(environment, spec)
    observation, info = environment.reset(seed=0)
    mask = info.get(MASK_KEY) if has_choices(environment.action_space, spec) else None
    example = None if mask is None else mask_of_one(mask)
    transforms = Transforms(spec, environment.observation_space, environment.action_space, example)
    random, rows, over = RandomActions(transforms.spaces.actions, 0), list[np.ndarray](), False
    for _ in range(_FIRST_STEPS):
        try:
            observed = transforms.observe_one(observation, info.get(MASK_KEY), needed=not over)
        except ValueError:  # such as a mask without a legal choice
            break
        rows.extend(observed.frames.values())
        if over:
            break
        action = transforms.env_action(random.choose(observed.masks))
        observation, reward, terminated, truncated, info = environment.step(action)
        over = bool(terminated or truncated)
        rows.append(np.array([float(reward), over]))
    return rows


def _alike(rows: list[np.ndarray], others: list[np.ndarray]) -> bool:
    return all(
        row.shape == other.shape and np.allclose(row, other, rtol=1e-3, atol=1e-6)
        for row, other in zip(rows, others, strict=False)
    )


STEPS_FOR_MASKS = 10  # in which `info` may have a mask that is not read


def mask_warning(spaces: Spaces, info: Any, frames: Mapping[str, np.ndarray]) -> str:
    """Return a warning of a mask under a name that nobody reads, or an empty string.

    Args:
      spaces: as a run has them.
      info: of one environment, or of one agent of a game.
      frames: its observation, by component.
    """
    choices = sum(space.choices for space in spaces.discrete_actions.values())
    if spaces.masks or choices < 2:
        return ""
    for where, values in (("info", info), ("the observation", frames)):
        if isinstance(values, Mapping) and (name := unread_mask(values, choices)):
            return (
                f"{name!r} of {where} seems to say which of the {choices} choices are legal, but is no mask of the "
                f"policy: if it is one, give it as {MASK_KEY!r} from reset on, 1 for each legal choice, else 0"
            )
    return ""


_COLOURS = re.compile(r"\x1b\[[0-9;]*m|^WARN: ")


def gymnasium_notes(spec: EnvironmentSpec, modules: UserModules) -> tuple[str, ...]:
    """Return what gymnasium's checker says about an environment: its advice, then the check that failed, if one did.

    It also checks what training does not need, such as equal episodes for equal seeds. Only environments that gymnasium
    makes one at a time are checked, without wrappers and without what training changes in them.
    """
    if spec.backend not in ("gymnasium", "fast"):
        return ()
    try:
        with creation_errors(spec.id):
            registered = registration(spec.id, modules)
            if registered.entry_point is None:
                return ()
            kwargs: dict[str, Any] = copy.deepcopy(spec.kwargs)  # which it may change in place
            environment = gymnasium.make(registered, disable_env_checker=True, **kwargs).unwrapped
    except EnvironmentSetupError:
        return ()  # reported before
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            _play_legally(environment)
            check_env(environment, skip_render_check=True)
            failed = ()
        except (Exception, SystemExit) as error:  # of its assertions, or of the user's code
            failed = (f"gymnasium's checker: {first_line(error)}",)
        finally:
            with suppress(Exception, SystemExit):  # of the user's code
                environment.close()
    said = dict.fromkeys(_plain(str(each.message)) for each in caught)
    return (*(f"gymnasium's checker: {text}" for text in said), *failed)


def _play_legally(environment: gymnasium.Env) -> None:
    """Replace the checker's actions by legal ones if the environment has masks: the checker knows none."""
    with suppress(EnvironmentSetupError, ValueError):  # reported before
        first = _Masks(environment, *environment.reset(seed=0))
        if not first.spaces.masks:
            return
        newest = [first]
        reset, step = environment.reset, environment.step

        @functools.wraps(reset)
        def reset_and_look(*arguments: Any, **keywords: Any) -> Any:
            result = reset(*arguments, **keywords)
            newest[0] = _Masks(environment, *result)
            return result

        @functools.wraps(step)
        def step_legally(action: Any) -> Any:  # the checker's own action is replaced
            result = step(newest[0].legal_action())
            if not (result[2] or result[3]):
                newest[0] = _Masks(environment, result[0], result[4])
            return result

        environment.reset, environment.step = reset_and_look, step_legally


class _Masks:
    """The legal actions after one observation of an environment."""

    def __init__(self, environment: gymnasium.Env, observation: Any, info: dict[str, Any]) -> None:
        given = environment.get_wrapper_attr("action_masks")() if hasattr(environment, "action_masks") else None
        mask = info.get(MASK_KEY) if given is None else given
        space = environment.observation_space
        spec = EnvironmentSpec(id="Any-v0", leave_out=Texts(space, ()).names)
        example = None if mask is None else mask_of_one(mask)
        self._transforms = Transforms(spec, space, environment.action_space, example)
        self.spaces = self._transforms.spaces
        self._masks = self._transforms.observe_one(observation, mask).masks

    def legal_action(self) -> Any:
        """Return a legal action of the environment, always the same one."""
        return self._transforms.env_action(RandomActions(self.spaces.actions, 0).choose(self._masks))


def _plain(text: str) -> str:
    return " ".join(_COLOURS.sub("", _COLOURS.sub("", text)).split())
