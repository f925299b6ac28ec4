"""Records the episodes of an environment into a dataset, whoever plays: a policy, a bot, a person at the keyboard."""

import copy
import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

import gymnasium
import numpy as np

from daedalus.actor.checking.violations import flag_violations
from daedalus.actor.environments.bots import make_bot
from daedalus.actor.environments.components import leaves, stacked
from daedalus.actor.environments.environment_errors import (
    EnvironmentSetupError,
    creation_errors,
    playing_error,
    raise_problem,
)
from daedalus.actor.environments.gymnasium_backend import EnvironmentFactory, as_on_gymnasium
from daedalus.actor.environments.info import MASK_KEY
from daedalus.actor.environments.minari_files import EPISODE_BYTES, Episode, MinariWriter
from daedalus.actor.evaluation.episodes import LONGEST
from daedalus.actor.evaluation.gamepad import INSTALL_PYGAME, Gamepad
from daedalus.actor.evaluation.loaded_policy import Policy, another_player
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import EnvironmentSpec

_logger = logging.getLogger(__name__)

_RATE = 30  # steps a second, where the environment does not say


class _EnoughError(Exception):
    """All episodes are recorded."""


class Player(Protocol):
    """Who chooses the actions."""

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        ...

    def act(self, observation: Any, action_mask: Any) -> Any:
        """Return the action, of the environment's own space."""
        ...


class PolicyPlayer:
    """A trained policy."""

    def __init__(self, policy: Policy, *, sampled: bool) -> None:
        """`sampled`: sample the actions, in place of the most probable ones."""
        self._policy, self._sampled = another_player(policy, Policy), sampled

    def reset(self, seed: int) -> None:
        """See Player."""
        self._policy.reset(seed=seed)

    def act(self, observation: Any, action_mask: Any) -> Any:
        """See Player. Raises EnvironmentSetupError for an observation that the policy cannot act on."""
        try:
            return self._policy.act(observation, sampled=self._sampled, action_mask=action_mask)
        except ValueError as error:
            raise EnvironmentSetupError(f"environment {self._policy.spec.environment.id}: {error}") from None


class BotPlayer:
    """`random`, or `module:Bot` of the user."""

    def __init__(self, name: str, space: gymnasium.Space, modules: UserModules) -> None:
        """See make_bot."""
        self._bot = make_bot(name, space, modules, "--by")
        self._has_choices = not isinstance(space, gymnasium.spaces.Box)

    def reset(self, seed: int) -> None:
        """See Player."""
        self._bot.reset("player", seed)

    def act(self, observation: Any, action_mask: Any) -> Any:
        """See Player."""
        if self._has_choices and isinstance(observation, Mapping) and MASK_KEY in observation:
            action_mask = observation[MASK_KEY]
        return self._bot.act(observation, action_mask)


class Recorder(gymnasium.Wrapper):
    """Writes each episode that ends into a dataset. An episode that is left before its end is not written.

    An episode is in memory until its end. One that goes on for too long, or has a gigabyte, is truncated.
    """

    def __init__(
        self, environment: gymnasium.Env, writer: MinariWriter, *, episodes: int, seed: int, longest: int = LONGEST
    ) -> None:
        """Record `episodes` episodes, the first one of the environment with this seed, the next with the next.

        `longest`: truncate each episode after this many steps, or after the environment's own limit if that is larger.
        """
        super().__init__(environment)
        own_limit = environment.spec.max_episode_steps if environment.spec is not None else None
        self._longest = max(longest, own_limit or 0)
        spaces = (environment.observation_space, "observation"), (environment.action_space, "action")
        self._parts = [leaves(*each) for each in spaces]
        self._bytes = 0  # of the running episode
        self._writer, self._wanted, self._seed = writer, episodes, seed
        self._name = environment.spec.id if environment.spec is not None else type(environment.unwrapped).__name__
        self._observations: list[Any] = []
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._gamepad: Gamepad | None = None  # chooses the actions in place of whoever steps
        self._has_warned = False  # of an episode that is too long
        self._plays = False  # itself, and not a loop of the user's, which gets the environment's own exceptions
        self.returns: list[float] = []  # of the recorded episodes

    @property
    def seed(self) -> int:
        """Seed of the next episode."""
        return self._seed + len(self.returns)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, with the recorder's own seed. Raises _EnoughError after the last one."""
        if len(self.returns) >= self._wanted:
            raise _EnoughError
        with self._faults("reset"):
            observation, info = self.env.reset(seed=self.seed, options=options)
        self._observations, self._actions, self._rewards = [copy.deepcopy(observation)], [], []
        self._bytes = 0
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and write the episode if it ends. Raises DatasetError, and EnvironmentSetupError if it cannot be."""
        if self._gamepad is not None:
            action = self._gamepad.action()
        # Environments and players may use the same arrays again.
        self._actions.append(copy.deepcopy(action))
        with self._faults("step"):
            observation, reward, terminated, truncated, info = self.env.step(action)
            self._observations.append(copy.deepcopy(observation))
            self._rewards.append(float(reward))
            raise_problem(f"environment {self._name}", flag_violations("terminated", terminated))
            raise_problem(f"environment {self._name}", flag_violations("truncated", truncated))
            truncated = truncated or (not terminated and self._is_too_long(observation, action))
        if terminated or truncated:
            with self._faults("step"):  # such as observations of different shapes
                observations = stacked(self.observation_space, self._observations)
            episode = Episode(
                observations=observations,
                actions=stacked(self.action_space, self._actions),
                rewards=np.array(self._rewards),
                terminated=bool(terminated),
                truncated=bool(truncated),
            )
            self._writer.add(episode, seed=self.seed)
            self.returns.append(sum(self._rewards))
        return observation, reward, terminated, truncated, info

    def _is_too_long(self, observation: Any, action: Any) -> bool:
        """Count a step, and return whether the episode has as much as is kept of one. Log a warning the first time."""
        values = zip(self._parts, (observation, action), strict=True)
        size = sum(leaf.of(value).nbytes for parts, value in values for leaf in parts)
        self._bytes += size
        if len(self._rewards) < self._longest and self._bytes + 2 * size <= EPISODE_BYTES:
            return False
        if not self._has_warned:
            self._has_warned = True
            _logger.warning(
                "an episode has not ended after %s steps and is recorded as truncated there, as others will be: if the "
                "environment never ends them, give it a time limit (gymnasium.register(max_episode_steps=...))",
                f"{len(self._rewards):,}",
            )
        return True

    @contextmanager
    def _faults(self, call: str) -> Iterator[None]:
        """Raise EnvironmentSetupError for whatever the environment raises while `play` or `play_in_window` plays."""
        try:
            yield
        except EnvironmentSetupError:
            raise
        except Exception as error:  # broad: the user's code may raise anything
            if not self._plays:
                raise
            raise playing_error(self._name, call, error) from error

    def play(self, player: Player) -> None:
        """Let a player play all episodes. Raises EnvironmentSetupError for its faults, and DatasetError."""
        self._plays = True
        while len(self.returns) < self._wanted:
            player.reset(self.seed)
            observation, info = self.reset()
            over = False
            while not over:
                action = player.act(observation, info.get(MASK_KEY))
                observation, _, terminated, truncated, info = self.step(action)
                over = terminated or truncated

    def play_in_window(self, keys: dict[str, Any] | None, idle: Any, rate: int | None, gamepad: Gamepad | None) -> None:
        """Let a person play in a window, until all episodes are recorded or it is closed.

        Args:
          keys: an action for each key, or for several that are pressed together; None: those of the environment.
          idle: the action while no key is pressed.
          rate: steps a second; None: the environment's own.
          gamepad: chooses the actions in place of keys; it is closed at the end.

        Raises EnvironmentSetupError if there is no window or there are no keys, and DatasetError.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # its plots, which are not used, lack a window or matplotlib
                from gymnasium.utils.play import MissingKeysToAction, play
        except (ImportError, gymnasium.error.DependencyNotInstalled):
            raise EnvironmentSetupError(f"a window needs pygame: {INSTALL_PYGAME}") from None
        import pygame

        space, self._gamepad, self._plays = self.action_space, gamepad, True
        actions = {} if gamepad is not None else keys
        if actions is not None:
            actions = {"".join(key): action_of(space, value) for key, value in actions.items()}
        try:
            self._check_picture()
            play(
                self,
                keys_to_action=actions,  # pyright: ignore[reportArgumentType]
                noop=action_of(space, idle),
                fps=rate or round(self.metadata.get("render_fps") or _RATE),
            )
        except _EnoughError:
            pass
        except MissingKeysToAction as error:
            raise EnvironmentSetupError(f"the keyboard cannot play: {error}: name keys with --key K=ACTION") from None
        except (pygame.error, ValueError, TypeError) as error:
            raise EnvironmentSetupError(f"nobody can play in a window: {error}") from None
        finally:
            if gamepad is not None:
                gamepad.close()
            pygame.quit()

    def _check_picture(self) -> None:
        self.reset()
        picture = self.render()
        if not isinstance(picture, np.ndarray):
            raise EnvironmentSetupError(
                "the environment shows a person no picture: its render() must return an array with "
                f"render_mode='rgb_array', and returns {type(picture).__name__}"
            )


def action_of(space: gymnasium.Space, given: Any) -> Any:
    """Return an action that was written as JSON as the space has it; None: zeros.

    Raises EnvironmentSetupError if it is none.
    """
    written = np.zeros(space.shape or ()).tolist() if given is None else given
    try:
        action = np.asarray(written, space.dtype)
        fits = action.dtype.kind == "f" or bool((action == np.asarray(written)).all())  # 0.5 is no choice
        action = action[()] if space.shape == () else action
        if fits and space.contains(action):
            return action
    except (ValueError, TypeError, OverflowError):
        pass
    raise EnvironmentSetupError(f"the action {written} of a key, or without one, is outside {space}")


def recorded_environment(spec: EnvironmentSpec, modules: UserModules, *, for_person: bool) -> gymnasium.Env:
    """Return one environment as evaluations play it, whose actions nobody repeats.

    `for_person`: whether Recorder.play_in_window will play it. Raises EnvironmentSetupError.
    """
    if spec.is_game:
        raise EnvironmentSetupError("datasets are of one agent, and this environment has several")
    if for_person:
        _open_display()
    plain = as_on_gymnasium(spec.as_evaluated()).model_copy(update={"action_repeat": 1, "processes": False})
    with creation_errors(spec.id):
        return EnvironmentFactory(spec=plain, modules=modules, render_mode="rgb_array" if for_person else None)()


def _open_display() -> None:
    """Open the display of SDL before an environment is made that renders pictures, which needs none.

    Raises EnvironmentSetupError if there is no display, or pygame is not installed.
    """
    try:
        import pygame
    except ImportError:
        raise EnvironmentSetupError(f"a window needs pygame: {INSTALL_PYGAME}") from None
    try:
        pygame.display.init()
        driver = pygame.display.get_driver()
    except pygame.error as error:
        driver = str(error)
    else:
        if driver != "offscreen" or os.environ.get("SDL_VIDEODRIVER"):
            return
    raise EnvironmentSetupError(
        f"there is no display for the window ({driver}): play on a machine with a screen, or over `ssh -X`"
    )


def spec_to_record(environment: gymnasium.Env) -> Any:
    """Return gymnasium's specification of an environment, for whoever makes it from a dataset again."""
    for each in (environment, environment.unwrapped):
        try:
            if each.spec is not None:
                each.spec.to_json()
                return each.spec
        except (TypeError, ValueError):  # of a wrapper, or of an argument, that JSON does not have
            continue
    return None
