"""Backend `pettingzoo`: environments with several agents, each of which is a seat with rows of its own.

A copy of the game is stepped until some of its seats must act (game_copies.py). Agents that act together, in turns,
leave early or appear late are then one case: each step says which seats have something new.
"""

import importlib
import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import create_empty_array

from daedalus.actor.environments.bots import Bot, LegalActions
from daedalus.actor.environments.components import dtype_misfit, leaves, numbered, only_of_batch, with_agent, without
from daedalus.actor.environments.environment_errors import (
    EnvironmentSetupError,
    MissingPackageError,
    close_each,
    creation_errors,
    described,
    hint_of_count,
    import_extra,
    of_module,
    playing_error,
)
from daedalus.actor.environments.game_copies import GameCopy, Outcome, game_copy, without_checks
from daedalus.actor.environments.info import MASK_KEY, EpisodeInfo, info_to_keep, mask_of_one
from daedalus.actor.environments.rendering import frame_rate, render_without_display
from daedalus.actor.environments.roles import DifferentSpacesError, roles_of
from daedalus.actor.environments.vector_environments import BackendStep
from daedalus.actor.environments.wrappers import Camera
from daedalus.policy.user_code import first_line
from daedalus.policy.user_modules import USER_STATE, UserModuleError, UserModules
from daedalus.protocol.spec import GAME_PACKAGES, EnvironmentSpec
from daedalus.protocol.texts import listed

_SHOWN = ("ansi", "rgb_array")  # render modes, the best first

_logger = logging.getLogger(__name__)


class GameEnvironments:
    """A BackendEnvironments of E seats: those of each copy of a game side by side, copy after copy."""

    def __init__(self, name: str, copies: Sequence[Any], spec: EnvironmentSpec, seats: tuple[Any, ...]) -> None:
        """Construct from PettingZoo environments, and reset them: only a reset shows whether there are masks.

        Args:
          name: id of the game, for errors.
          copies: the environments, of one kind.
          spec: which components are left out, and whether the observation names the agent.
          seats: the agents that have seats. The others take random legal actions. An agent may be any object, such as a
            number; its name is then the text of it.

        Raises EnvironmentSetupError.
        """
        self.name, self.agents = name, tuple(map(str, seats))
        self._environments = [without_checks(environment, spec) for environment in copies]
        self.seats = len(seats)
        self.count = len(copies) * len(seats)
        self._numbers = {agent: number for number, agent in enumerate(seats)}
        self._random = [np.random.default_rng(number) for number in range(len(copies))]
        self._others: dict[str, LegalActions] = {}  # of the agents without a seat
        self._games = self.copies_for()
        self._bots: list[Bot | None] = [None] * self.count  # of the seats, from the next match on
        self._in_match: list[Bot | None] = [None] * self.count
        self._newest: list[tuple[Any, Any]] = [(None, None)] * self.count  # observation and mask of each bot's seat
        self._agent_ids = spec.agent_ids
        self._of_game: gymnasium.Space = copies[0].observation_space(seats[0])
        self.observation_space = with_agent(self._of_game, len(seats)) if spec.agent_ids else self._of_game
        self.action_space: gymnasium.Space = copies[0].action_space(seats[0])
        read = without(self.observation_space, spec.leave_out)
        self.observations: Any = create_empty_array(self.observation_space, self.count)
        self._leaves = [  # each with its array of the observations of all seats
            (leaf, leaf.of(self.observations)) for leaf in leaves(read, "observation") if leaf.space.shape is not None
        ]
        self.infos: list[Any] = [{}] * self.count  # the newest `info` of each seat, as the game gives it
        self._ended = np.zeros(self.count, np.bool_)
        self._acts = np.zeros(self.count, np.bool_)  # whether the seat has acted in this match
        self._warned = set[str]()  # of which rewards
        self.resting = np.zeros(len(copies), np.bool_)  # copies that do not begin another match
        self._abandoned = np.zeros(len(copies), np.bool_)  # copies whose match goes on, but not here
        self.openings = 0  # see LeagueSpec
        self._episode_info = EpisodeInfo()
        self._camera: Camera | None = None
        self.acting = np.zeros(self.count, np.bool_)
        self.action_mask: Any = None
        self._has_masks: bool | None = None  # in `info`; None before the first reset
        self.reset(0)

    def copies_for(self, agents: Sequence[Any] = ()) -> list[GameCopy]:
        """Return each copy as a game in which these agents have seats, or those of this object; the others take random
        legal actions."""
        agents = agents or tuple(self._numbers)
        return [
            game_copy(environment, agents, partial(self._random_action, number), self._warn_of_lost_reward)
            for number, environment in enumerate(self._environments)
        ]

    @property
    def over(self) -> np.ndarray:
        """Whether the match of each copy has ended, [copies] bool."""
        return self._abandoned | [game.is_over for game in self._games]

    def is_over(self, copy: int) -> bool:
        """Return whether the match of a copy has ended."""
        return bool(self._abandoned[copy]) or self._games[copy].is_over

    def abandon(self, copy: int) -> None:
        """End the match of a copy without a result: its next step is a reset, unless it rests."""
        self._abandoned[copy] = True
        seats = slice(copy * self.seats, (copy + 1) * self.seats)
        self._ended[seats], self._acts[seats] = True, False

    def seat_bot(self, seat: int, bot: Bot | None) -> None:
        """Let a bot choose the actions of a seat from the next match of its copy on; None: the caller chooses them.

        A bot's seat is `acting` as others are, and what the caller chooses for it has no effect. A bot plays one seat.
        """
        self._bots[seat] = bot

    def reset(self, seed: int) -> Any:
        """See BackendEnvironments."""
        self.acting = np.zeros(self.count, np.bool_)
        self._ended[:] = self._acts[:] = False
        for number in range(len(self._games)):
            self._random[number] = np.random.default_rng(seed + number)
            self._note(number, self._begin_match(number, seed + number))
        self.acting &= ~self._ended  # an episode that ends before its first action has no beginning
        self._film()
        return self.observations

    def _begin_match(self, number: int, seed: int | None) -> list[Outcome]:
        """Reset a copy, play its opening, and return what is new for the agents that have seats."""
        self._abandoned[number] = False
        for place, agent in enumerate(self.agents):
            seat = number * self.seats + place
            bot = self._in_match[seat] = self._bots[seat]
            if bot is not None:
                bot.reset(agent, int(self._random[number].integers(2**31)))
        outcomes = self._call("reset", number, seed)
        game, left = self._games[number], list[Outcome]()  # of agents that have left in the opening
        moves = int(self._random[number].integers(self.openings + 1)) if self.openings else 0
        for _ in range(moves):
            newest = {outcome.agent: outcome for outcome in outcomes}
            chosen = {
                agent: self._random_action(number, agent, newest[agent].observation, newest[agent].info)
                for agent in game.turns
            }
            outcomes = self._call("step", number, chosen)
            if game.is_over:
                return self._call("reset", number, None)
            left += [outcome for outcome in outcomes if outcome.terminated or outcome.truncated]
        newest = {outcome.agent: outcome for outcome in (*left, *outcomes)}
        return [outcome._replace(reward=0.0) for outcome in newest.values()] if moves else outcomes

    def step(self, actions: Any) -> BackendStep:
        """See BackendEnvironments. The actions of seats that were not acting have no effect."""
        rewards = np.zeros(self.count)
        terminated, truncated = np.zeros((2, self.count), np.bool_)
        acted, self.acting = self.acting, np.zeros(self.count, np.bool_)
        self._acts |= acted & ~self._ended
        for number, game in enumerate(self._games):
            if self._abandoned[number] or game.is_over:
                if self.resting[number]:
                    continue
                outcomes = self._begin_match(number, None)
            else:
                first = number * self.seats
                chosen = {agent: self._chosen(actions, first + self._numbers[agent]) for agent in game.turns}
                outcomes = self._call("step", number, chosen)
            self._note(number, outcomes)
            for outcome in outcomes:
                seat = number * self.seats + self._numbers[outcome.agent]
                rewards[seat] = outcome.reward
                terminated[seat], truncated[seat] = outcome.terminated, outcome.truncated
        self._film()
        return self.observations, rewards, terminated, truncated

    def _chosen(self, actions: Any, seat: int) -> Any:
        """Return the action of a seat that must act: its bot's, or the caller's."""
        bot = self._in_match[seat]
        return only_of_batch(self.action_space, actions, seat) if bot is None else bot.act(*self._newest[seat])

    def _call(self, call: str, number: int, argument: Any) -> list[Outcome]:
        try:
            with USER_STATE:
                outcomes: list[Outcome] = getattr(self._games[number], call)(argument)
        except EnvironmentSetupError as error:
            raise EnvironmentSetupError(f"environment {self.name}: {error}") from None
        except (Exception, SystemExit) as error:  # of the user's code
            raise playing_error(self.name, call, error) from error
        return outcomes

    def _note(self, number: int, outcomes: list[Outcome]) -> None:
        """Write what is new for the seats of a copy."""
        for outcome in outcomes:
            seat = number * self.seats + self._numbers[outcome.agent]
            self._write(seat, outcome)
            self.acting[seat], self.infos[seat] = True, outcome.info
            if self._in_match[seat] is not None:
                self._newest[seat] = outcome.observation, mask_of(outcome.observation, outcome.info)
            if not self._acts[seat] and outcome.reward:
                self._warn_of_reward(
                    "early",
                    f"{outcome.agent} has the reward {outcome.reward:g} before its first action of a match: such "
                    "rewards count in results of matches, and are not learned from",
                )
            self._ended[seat] = outcome.terminated or outcome.truncated
            if self._ended[seat]:
                self._acts[seat] = False
                if outcome.info:
                    kept = info_to_keep(dict(outcome.info), ended=True)
                    kept.pop(MASK_KEY, None)  # it may be lists of different lengths
                    self._episode_info.add({name: np.array([kept[name]]) for name in kept}, np.array([True]))

    def _write(self, seat: int, outcome: Outcome) -> None:
        observation = outcome.observation
        if self._agent_ids:
            observation = numbered(observation, self._numbers[outcome.agent])
        for leaf, written in self._leaves:
            try:
                value = leaf.of(observation)
            except (KeyError, IndexError, TypeError, ValueError):
                value = None
            if value is None or value.shape != written.shape[1:] or dtype_misfit(leaf.space, value):
                raise EnvironmentSetupError(
                    f"environment {self.name}: {outcome.agent} observes {described(observation)}, which is not of its "
                    f"space {described(self._of_game)}"
                )
            written[seat] = value
        self._write_mask(seat, outcome)

    def _write_mask(self, seat: int, outcome: Outcome) -> None:
        mask = outcome.info.get(MASK_KEY) if isinstance(outcome.info, Mapping) else None
        if self._has_masks is None:
            self._has_masks = mask is not None
        if mask is None and not self._has_masks:
            return
        if mask is None:
            if not (outcome.terminated or outcome.truncated):
                raise EnvironmentSetupError(
                    f"environment {self.name}: info of {outcome.agent} has no {MASK_KEY!r} any more: "
                    "give it in every step"
                )
            return
        rows = mask_of_one(mask)
        if not self._has_masks or not isinstance(rows, np.ndarray):
            raise EnvironmentSetupError(
                f"environment {self.name}: info of {outcome.agent} has an {MASK_KEY} of another form than at first: "
                "give one array over all choices, from reset on"
            )
        if self.action_mask is None:
            self.action_mask = np.ones((self.count, rows.shape[1]), rows.dtype)
        if rows.shape[1] != self.action_mask.shape[1]:
            raise EnvironmentSetupError(
                f"environment {self.name}: the {MASK_KEY} of {outcome.agent} has {rows.shape[1]} choices, but had "
                f"{self.action_mask.shape[1]} before"
            )
        self.action_mask[seat] = rows[0]

    def _warn_of_lost_reward(self, agent: str, reward: float) -> None:
        self._warn_of_reward(
            "late",
            f"{agent} has the reward {reward:g} after it has left the match: such rewards count nowhere; let it stay, "
            "or give them with its last step",
        )

    def _warn_of_reward(self, kind: str, text: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            _logger.warning("environment %s: %s", self.name, text)

    def _random_action(self, number: int, agent: str, observation: Any, info: Any) -> Any:
        """Return a legal action of an agent without a seat."""
        if agent not in self._others:
            possible = self._environments[0].possible_agents
            if agent not in possible:
                raise EnvironmentSetupError(
                    f"{agent!r} is in its `agents`, but not in its possible_agents, which are {listed(possible)}: the "
                    "policy could not play it"
                )
            self._others[agent] = LegalActions(self._environments[0].action_space(agent))
        return self._others[agent].sample(mask_of(observation, info), self._random[number])

    def render(self) -> str | np.ndarray | None:
        """Return the first copy as a text or an image [H, W, 3] uint8; None if the games were not made to be shown."""
        environment = self._environments[0]
        if getattr(environment, "render_mode", None) not in _SHOWN:
            return None
        try:
            with USER_STATE:
                shown = environment.render()
        except (Exception, SystemExit) as error:  # of the user's code
            raise playing_error(self.name, "render", error) from error
        if isinstance(shown, str) or (isinstance(shown, np.ndarray) and shown.ndim == 3):
            return shown
        return None

    def film(self, camera: Camera) -> None:
        """Pass an image of the first copy to a camera after each reset and each step from now on."""
        self._camera = camera

    def _film(self) -> None:
        if self._camera is None:
            return
        picture = self.render()
        if not isinstance(picture, np.ndarray):
            raise EnvironmentSetupError(
                f"environment {self.name} renders no image [height, width, 3]: a video of it cannot be recorded"
            )
        self._camera(picture, frame_rate(self._environments[0]))

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """See BackendEnvironments."""
        return self._episode_info.take()

    def close(self) -> None:
        """Close all copies, then raise the first exception that one of them raised."""
        environments, self._environments = self._environments, []
        close_copies(self.name, environments)


def close_copies(name: str, environments: Sequence[Any]) -> None:
    """Close all copies of a game, then raise the first exception that one of them raised."""
    try:
        close_each(environments)
    except (Exception, SystemExit) as error:  # of the user's code
        raise EnvironmentSetupError(f"environment {name}: close raises {first_line(error)}") from error


def mask_of(observation: Any, info: Any) -> Any:
    """Return the mask of legal actions that a game gives with an observation, or None."""
    mask = observation.get(MASK_KEY) if isinstance(observation, Mapping) else None
    return info.get(MASK_KEY) if mask is None and isinstance(info, Mapping) else mask


def make_games(
    spec: EnvironmentSpec,
    count: int,
    modules: UserModules,
    further: Callable[[tuple[str, ...]], int] = lambda _: 0,
    *,
    shown: bool = False,
    render_mode: str | None = None,
) -> GameEnvironments:
    """Return copies of the game that a specification names.

    Args:
      spec: names the game.
      count: of copies.
      modules: the modules that may be imported for it.
      further: returns how many copies more the seats demand.
      shown: whether the copies render texts or images, if they can.
      render_mode: in place of `shown`, how they must render: "rgb_array", or "human" for a window.

    Raises EnvironmentSetupError, and what `further` raises.
    """
    make = _make_shown if shown else _make
    if render_mode is not None:
        make = partial(_make_rendered, mode=render_mode)
    copies = make_copies(spec, count, modules, lambda game: further(tuple(map(str, _seats(game, spec)))), make)
    try:
        return GameEnvironments(spec.id, copies, spec, _seats(copies[0], spec))
    except BaseException:
        for each in copies:
            each.close()
        raise


def make_copies(
    spec: EnvironmentSpec,
    count: int,
    modules: UserModules,
    further: Callable[[Any], int] = lambda _: 0,
    make: Callable[[EnvironmentSpec, UserModules], Any] | None = None,
) -> list[Any]:
    """Return `count` PettingZoo environments of one kind, and as many more as `further` returns for the first.

    `make` makes each of them, in place of what the specification says. See make_games.
    """
    copies: list[Any] = []
    try:
        while len(copies) < count:
            with creation_errors(spec.id, hint_of_count(len(copies), count)):
                copies.append((make or _make)(spec, modules))
            if len(copies) == 1:
                count += further(copies[0])
    except BaseException:
        for each in copies:
            each.close()
        raise
    return copies


def _make_shown(spec: EnvironmentSpec, modules: UserModules) -> Any:
    """Return a game that renders itself as a text or an image if it can: it says so in its metadata."""
    render_without_display()
    environment = _make(spec, modules)
    modes = getattr(environment, "metadata", {}).get("render_modes", ())
    mode = next((mode for mode in _SHOWN if mode in modes), None)
    if mode is None or "render_mode" in spec.constructor_kwargs:
        return environment
    try:
        rendered = _make(spec, modules, render_mode=mode)
    except (Exception, SystemExit) as error:  # of the user's code: its function need not have this argument
        _logger.warning("environment %s cannot be made with render_mode=%r: %s", spec.id, mode, first_line(error))
        return environment
    environment.close()
    return rendered


def _make_rendered(spec: EnvironmentSpec, modules: UserModules, mode: str) -> Any:
    """Return a game in a render mode. Raises EnvironmentSetupError if it has none."""
    if mode == "rgb_array":
        render_without_display()
    try:
        environment = _make(spec, modules, render_mode=mode)
    except TypeError as error:
        if "keyword argument 'render_mode'" not in str(error):
            raise
        reason = "what makes it has no argument render_mode"
    else:
        modes = tuple(getattr(environment, "metadata", {}).get("render_modes", ()))
        if mode in modes:
            return environment
        environment.close()
        reason = f"its metadata state the render_modes {', '.join(map(str, modes)) or 'none'}"
    raise EnvironmentSetupError(f"environment {spec.id} cannot render {mode} images: {reason}")


def _make(spec: EnvironmentSpec, modules: UserModules, **options: Any) -> Any:
    module_name, colon, function = spec.id.partition(":")
    if colon:
        try:
            make = modules.attribute("environment.id", spec.id)
        except UserModuleError as error:
            raise of_module(error) from error
    else:
        module = _module(module_name)
        make = getattr(module, "parallel_env", None) or getattr(module, "env", None)
        function = "env"
    if not callable(make):
        raise EnvironmentSetupError(f"environment {spec.id}: there is no function {function}() that makes the game")
    environment = make(**{**spec.constructor_kwargs, **options})
    if not hasattr(environment, "possible_agents"):
        raise EnvironmentSetupError(
            f"environment {spec.id} made {type(environment).__name__}, which has no possible_agents: "
            "return a PettingZoo AECEnv or ParallelEnv"
        )
    return environment


def _module(name: str) -> Any:
    package = name.partition(".")[0]
    if package not in GAME_PACKAGES:
        raise EnvironmentSetupError(
            f"unknown game {name!r}: name a module of {' or '.join(GAME_PACKAGES)}, or module:function for your own"
        )
    import_extra(package, "pettingzoo", f"environment {name}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # newer releases also have names without a module
            return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and name.startswith(error.name):
            raise EnvironmentSetupError(f"unknown game {name!r}: {first_line(error)}") from None
        group = name.split(".")[1]  # such as classic: PettingZoo has an extra of that name for what its games need
        remedy = f'pip install "pettingzoo[{group}]"' if package == "pettingzoo" else "install it"
        raise MissingPackageError(
            f"environment {name} needs a package that is not installed ({error.name}): {remedy}"
        ) from None


def _seats(environment: Any, spec: EnvironmentSpec) -> tuple[Any, ...]:
    """Return the agents that the policy plays. Raises EnvironmentSetupError if their spaces differ."""
    agents = {str(agent): agent for agent in environment.possible_agents}
    possible = tuple(agents)
    if not possible or len(possible) < len(environment.possible_agents):
        raise EnvironmentSetupError(
            f"environment {spec.id}: its possible_agents are {environment.possible_agents!r}: name at least one agent, "
            "and each by another name"
        )
    unknown = [agent for agent in spec.agents if agent not in possible]
    if unknown:
        raise EnvironmentSetupError(
            f"environment.agents names {unknown[0]!r}, but the agents of {spec.id} are {listed(possible)}"
        )
    chosen = tuple(agent for agent in possible if agent in spec.agents) or possible
    groups: dict[str, list[str]] = {}
    for agent in chosen:
        spaces = f"{environment.observation_space(agents[agent])} {environment.action_space(agents[agent])}"
        groups.setdefault(spaces, []).append(agent)
    if len(groups) > 1:
        raise DifferentSpacesError(spec.id, roles_of(list(groups.values()), possible))
    return tuple(agents[agent] for agent in chosen)
