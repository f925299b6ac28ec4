"""Bots: players of games that are code, `random` or a class of the user's module. They act on the game's own spaces."""

from typing import Any, Protocol

import gymnasium
import numpy as np

from daedalus.actor.environments.components import ActionComponents, batch_of_one, only_of_batch
from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described
from daedalus.actor.environments.info import MASK_KEY, Masks, mask_of_one
from daedalus.policy.user_code import first_line, place_of, print_traceback
from daedalus.policy.user_modules import USER_STATE, UserModuleError, UserModules
from daedalus.protocol.league import RANDOM
from daedalus.protocol.spaces import ActionSpace, ContinuousSpace, DiscreteSpace


class Bot(Protocol):
    """A player of one seat. That of a user may lack `reset`."""

    def reset(self, agent: str, seed: int) -> None:
        """Begin a match as an agent of the game."""
        ...

    def act(self, observation: Any, action_mask: Any) -> Any:
        """Return the action for an observation of the agent, both of the game's own spaces.

        Args:
          observation: as the game gives it, with its mask if that is a part of it.
          action_mask: the mask of legal actions in the observation or in info, as the game gives it; None without one.
        """
        ...


def make_bot(name: str, space: gymnasium.Space, modules: UserModules, setting: str = "league.opponents") -> Bot:
    """Return a new bot, which plays one seat.

    Args:
      name: `random`, or `module:Bot` of a class or function that is called without arguments.
      space: of the seat's actions.
      modules: the modules that may be imported for it.
      setting: what names it, for messages.

    Raises EnvironmentSetupError, of one line, if it cannot be made. Its methods raise EnvironmentSetupError for an
    exception of the user's code, and for an action that is illegal or outside the space.
    """
    if name == RANDOM:
        return _RandomBot(space)
    try:
        make = modules.attribute(setting, name)
        with USER_STATE.undone():
            bot = make()
        act = getattr(bot, "act", None)
    except UserModuleError as error:
        raise EnvironmentSetupError(str(error)) from error
    except (Exception, SystemExit) as error:  # of the user's code
        print_traceback(error)
        raise EnvironmentSetupError(f"opponent {name} cannot be made: {first_line(error)}{place_of(error)}") from error
    if not callable(act):
        raise EnvironmentSetupError(
            f"opponent {name} made {type(bot).__name__}, which has no act(observation, action_mask): define it"
        )
    return _OwnBot(name, bot, space)


class _RandomBot:
    def __init__(self, space: gymnasium.Space) -> None:
        self._actions, self._random = LegalActions(space), np.random.default_rng(0)

    def reset(self, agent: str, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def act(self, observation: Any, action_mask: Any) -> Any:
        return self._actions.sample(action_mask, self._random)


class _OwnBot:
    """A bot of the user, whose faults are named."""

    def __init__(self, name: str, bot: Any, space: gymnasium.Space) -> None:
        self._name, self._bot, self._space = name, bot, space
        self._actions, self._agent = LegalActions(space), ""

    def reset(self, agent: str, seed: int) -> None:
        self._agent = agent
        if hasattr(self._bot, "reset"):
            self._call("reset", agent, seed)

    def act(self, observation: Any, action_mask: Any) -> Any:
        given = self._call("act", observation, action_mask)
        try:
            action = only_of_batch(self._space, batch_of_one(self._space, given, "its action"))
            if not self._space.contains(action):
                raise ValueError(f"its action is {given}, which is outside {self._space}")
        except Exception as error:  # broad: the action may be any object
            raise EnvironmentSetupError(f"opponent {self._name}, as {self._agent}: {described(error)}") from None
        if not self._actions.allow(action, action_mask):
            raise EnvironmentSetupError(
                f"opponent {self._name}, as {self._agent}: its action is {described(given)}, which the {MASK_KEY} "
                "forbids"
            )
        return action

    def _call(self, method: str, *arguments: Any) -> Any:
        try:
            with USER_STATE:
                return getattr(self._bot, method)(*arguments)
        except (Exception, SystemExit) as error:  # of the user's code
            print_traceback(error)
            raise EnvironmentSetupError(
                f"opponent {self._name}: {method} raises {first_line(error)}{place_of(error)}"
            ) from error


class LegalActions:
    """The actions of a space of the game that a mask allows."""

    def __init__(self, space: gymnasium.Space) -> None:
        """Construct from the space of one agent's actions. Raises EnvironmentSetupError if it is not supported."""
        self._space, self._components = space, ActionComponents(space)
        self._masks: Masks | None = None  # known with the first one

    def allow(self, action: Any, action_mask: Any) -> bool:
        """Return whether a mask allows an action of the space. Raises EnvironmentSetupError for an unfit mask."""
        masks = self._by_component(action_mask)
        if self._masks is None:
            return True
        return self._masks.allow(self._components.policy_actions(batch_of_one(self._space, action)), masks)

    def sample(self, action_mask: Any, random: np.random.Generator) -> Any:
        """Return a legal action, each with the same probability. Raises EnvironmentSetupError if there is none."""
        values = RandomActions(self._components.spaces, random).choose(self._by_component(action_mask))
        return only_of_batch(self._space, self._components.env_actions(values))

    def _by_component(self, action_mask: Any) -> dict[str, np.ndarray]:
        """Return the masks {name: [1, choices]} of the components that have masks."""
        if action_mask is None:
            return {}
        rows = mask_of_one(action_mask)
        if self._masks is None:
            self._masks = Masks(self._components.spaces, rows)
        return self._masks(rows, np.ones(1, np.bool_))


class RandomActions:
    """A policy that draws every action at random from those that are legal."""

    def __init__(self, spaces: dict[str, ActionSpace], seed: int | np.random.Generator) -> None:
        self._spaces = spaces
        self._random = np.random.default_rng(seed)

    def choose(self, masks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return actions {name: [1, D]}, given the masks {name: [1, choices]} of the components that have masks."""
        return {name: self._values(space, masks.get(name))[None] for name, space in self._spaces.items()}

    def choose_each(self, masks: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
        """Return actions {name: [count, D]} of several environments, given the masks {name: [count, choices]}."""
        rows = [self.choose({name: mask[[row]] for name, mask in masks.items()}) for row in range(count)]
        return {name: np.concatenate([row[name] for row in rows]) for name in self._spaces}

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
