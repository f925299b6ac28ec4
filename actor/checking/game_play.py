"""Plays one copy of a game with several agents, all with random actions, and reports what it does. No threads."""

import time
from collections.abc import Sequence
from contextlib import closing, suppress
from typing import Any

import numpy as np
from gymnasium.vector.utils import batch_space, iterate

from daedalus.actor.checking.check_report import EnvironmentReport
from daedalus.actor.checking.checker import STEPS_FOR_MASKS, mask_warning, seed_warnings
from daedalus.actor.checking.violations import byte_maxima, learned_reward_violations, observation_violations
from daedalus.actor.environments.bots import LegalActions, RandomActions, make_bot
from daedalus.actor.environments.components import without
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.games import GameEnvironments, make_copies, make_games, mask_of
from daedalus.actor.environments.gymnasium_environments import limited_close
from daedalus.actor.environments.info import unreported
from daedalus.actor.environments.precision import Precision
from daedalus.actor.environments.roles import DifferentSpacesError
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.environments.vector_environments import Observed
from daedalus.policy.user_modules import UserModuleError, UserModules
from daedalus.protocol.spaces import StillObservations, unfit_number
from daedalus.protocol.spec import EnvironmentSpec

_FEWEST_TOGETHER = 50  # steps of several agents after which equal observations are no chance
_WRAPPER = "in a wrapper (--wrap)"  # which games have not
_LOOKED_AT = 200  # steps whose observations are compared with their space: it takes longer than most steps


def check_game(
    spec: EnvironmentSpec,
    modules: UserModules,
    *,
    seconds: float,
    env_steps: int,
    seed: int,
    bots: Sequence[str],
) -> EnvironmentReport:
    """Make one copy of a game, play it with random actions in all seats, and close it. See check_environment.

    Then each of the `bots` plays a match in all seats. The return of an episode is the mean over the agents.
    """
    began = time.monotonic()
    try:
        modules.check(spec.user_modules)
        games = make_games(spec, 1, modules)
    except DifferentSpacesError as error:
        return EnvironmentReport(problems=(str(error),), roles=error.roles)
    except (EnvironmentSetupError, UserModuleError) as error:
        return EnvironmentReport(problems=(str(error),))
    try:
        environments = TransformedEnvironment(games, spec)
        report = EnvironmentReport(spaces=environments.spaces, seats=environments.seats)
        if seconds == 0.0:
            return report
        report = report.model_copy(update=_Play(environments, games, spec).play(seconds, env_steps, seed))
        for bot in bots:
            _play_bot(environments, games, bot, modules, seed)
        is_slow = time.monotonic() - began > 2.0 * seconds + 1.0  # to make others could take as long
        if not is_slow:
            more = [*seed_warnings(spec, modules, seconds / 3), _rewards_warning(spec, modules, seconds / 3)]
            report = report.model_copy(update={"warnings": (*report.warnings, *filter(None, more))})
        return report
    except EnvironmentSetupError as error:
        return EnvironmentReport(problems=(str(error),))
    finally:
        with suppress(Exception, SystemExit), limited_close():  # of the user's code
            games.close()


class _Play:
    """One copy of a game that is played with random actions, and what it has shown."""

    def __init__(self, environments: TransformedEnvironment, games: GameEnvironments, spec: EnvironmentSpec) -> None:
        self._environments, self._games, self._spec = environments, games, spec
        self._space = without(games.observation_space, spec.leave_out)
        self._batch = batch_space(games.observation_space, games.count)
        self._warnings: dict[str, str] = {}  # the first of each kind
        self._precision = [Precision(self._space) for _ in range(games.count)]  # of each seat
        self._maxima = byte_maxima(environments.spaces)
        self._still = StillObservations()
        self._together, self._differ = 0, False  # steps that show several agents something new; whether they differ
        self._before: dict[str, np.ndarray] = {}  # the newest observations
        self._lengths, self._returns = list[int](), list[float]()
        self._steps, self._length, self._total = 0, 0, np.zeros(games.count)

    def play(self, seconds: float, env_steps: int, seed: int) -> dict[str, Any]:
        """Return the fields of the report that playing tells. Raises EnvironmentSetupError for a problem."""
        random = RandomActions(self._environments.spaces.actions, seed)
        began = time.monotonic()
        observed = self._environments.reset(seed)
        self._remember(observed)
        reset_seconds, busy, stepping = time.monotonic() - began, 0.0, 0.0
        until = time.monotonic() + seconds
        while not self._steps or (self._steps < env_steps and time.monotonic() < until):
            if self._steps < STEPS_FOR_MASKS and (text := _mask_warning(self._environments, self._games, observed)):
                self._warn("a mask", text)
            chosen = random.choose_each(observed.masks, self._games.count)
            began, began_busy = time.monotonic(), time.process_time()
            observed, rewards, terminated, truncated = self._environments.step(chosen)
            stepping, busy = stepping + time.monotonic() - began, busy + time.process_time() - began_busy
            self._take(observed, rewards, terminated | truncated)
        self._conclude()
        return {
            "warnings": tuple(self._warnings.values()),
            "env_steps": self._steps,
            "step_seconds": stepping / self._steps,
            "busy_share": min(busy / max(stepping, 1e-9), 1.0),
            "reset_seconds": reset_seconds,
            "lengths": tuple(self._lengths),
            "returns": tuple(self._returns),
            "byte_maxima": {name: tuple(map(int, each)) for name, each in self._maxima.items()},
        }

    def _warn(self, kind: str, text: str) -> None:
        self._warnings.setdefault(kind, f"environment {self._spec.id}: {text}")

    def _remember(self, observed: Observed) -> None:
        self._before = {name: frames.copy() for name, frames in observed.frames.items()}

    def _take(self, observed: Observed, rewards: np.ndarray, ended: np.ndarray) -> None:
        """Examine a step."""
        assert observed.acting is not None
        assert observed.over is not None
        self._steps, self._length, self._total = self._steps + 1, self._length + 1, self._total + rewards
        _refuse_unfit(self._games, self._spec, observed.frames, rewards)
        for name, largest in self._maxima.items():
            np.maximum(largest, observed.frames[name].reshape(-1, len(largest)).max(0), out=largest)
        goes_on = observed.acting & ~ended & (self._length > 0)  # no step that only resets
        pairs = {name: np.stack([frames, observed.frames[name]]) for name, frames in self._before.items()}
        self._still.add(pairs, goes_on[None])
        seats = np.flatnonzero(observed.acting)
        if len(seats) > 1 and not self._differ:
            self._together += any((frames != self._before[name]).any() for name, frames in observed.frames.items())
            self._differ = any((frames[seats] != frames[seats[0]]).any() for frames in observed.frames.values())
        self._remember(observed)
        if self._steps <= _LOOKED_AT:
            self._look(seats.tolist(), rewards)
        for seat in np.flatnonzero(ended):
            if text := unreported(self._games.infos[seat]):
                self._warn("a number", text)
        if observed.over[0]:
            self._lengths.append(self._length)
            self._returns.append(float(self._total.mean()))
            self._length, self._total = -1, np.zeros(self._games.count)  # the next step only resets

    def _look(self, seats: Sequence[int], rewards: np.ndarray) -> None:
        """Compare what the seats that act observe with their space."""
        rows = list(iterate(self._batch, self._games.observations))
        for seat in seats:
            self._precision[seat].add(rows[seat], starts=self._length == 0)
            self._precision[seat].add_reward(rewards[seat])
            for kind, text in observation_violations(self._space, rows[seat], "the game"):
                if kind == "problem":
                    raise EnvironmentSetupError(f"environment {self._spec.id}: {text}")
                self._warn(kind, text)

    def _conclude(self) -> None:
        """Add the warnings that all steps together give."""
        for seen in self._precision:
            for name, text in seen.warnings.items():
                self._warn(f"precision of {name}", text.replace(_WRAPPER, "in the game"))
        if text := self._still.text(len(self._lengths)):
            self._warn("still", text)
        if self._together >= _FEWEST_TOGETHER and not self._differ:
            self._warn(
                "alike",
                f"all agents that act observe the same in all of {self._together:,} rows, so that one policy cannot "
                "know which of them it plays: let it observe that (--set environment.agent_ids=true), unless they are "
                "to do the same",
            )


_ROUNDING = 1e-3  # relative, of sums of rewards


def _rewards_warning(spec: EnvironmentSpec, modules: UserModules, seconds: float) -> str:
    """Return a warning if the rewards of a game in turns are not those that its agents get, or an empty string.

    An AECEnv adds `rewards` to `_cumulative_rewards` after each step, which `last` returns, and sets those of the agent
    that acts to 0 before: its author calls two methods for it. One match is played, or nothing is known.
    """
    # Of the user's code; playing reports it. A second copy may not be possible beside the first.
    with suppress(Exception, SystemExit), closing(make_copies(spec, 1, modules)[0]) as game:
        if not hasattr(game, "agent_iter"):
            return ""
        random, until = np.random.default_rng(0), time.monotonic() + seconds
        actions = {agent: LegalActions(game.action_space(agent)) for agent in game.possible_agents}
        earned, received = (dict.fromkeys(game.possible_agents, 0.0) for _ in range(2))
        game.reset(seed=0)
        while game.agents:
            if time.monotonic() > until:
                return ""
            agent = game.agent_selection
            observation, reward, terminated, truncated, info = game.last()
            received[agent] += float(reward)
            if terminated or truncated:
                game.step(None)
                continue
            game.step(actions[agent].sample(mask_of(observation, info), random))
            for each, reward in game.rewards.items():
                earned[each] += float(reward)
        for agent, expected in earned.items():
            if not np.isclose(received[agent], expected, rtol=_ROUNDING, atol=1e-6):
                return (
                    f"environment {spec.id}: the `rewards` of {agent} in a match add up to {expected:g}, but it gets "
                    f"{received[agent]:g} by `last`, which is learned from: `step` must set _cumulative_rewards of the "
                    "agent that acts to 0 first, and call _accumulate_rewards() at its end"
                )
    return ""


def _mask_warning(environments: TransformedEnvironment, games: GameEnvironments, observed: Observed) -> str:
    """Return a warning of a mask that no agent reads, or an empty string."""
    assert observed.acting is not None
    found = (
        mask_warning(
            environments.spaces, games.infos[seat], {name: each[seat] for name, each in observed.frames.items()}
        )
        for seat in np.flatnonzero(observed.acting)
    )
    return next(filter(None, found), "")


def _play_bot(
    environments: TransformedEnvironment, games: GameEnvironments, bot: str, modules: UserModules, seed: int
) -> None:
    """Let a bot play one match, or the beginning of a long one. Raises EnvironmentSetupError for a fault of the bot."""
    for seat in range(games.count):
        games.seat_bot(seat, make_bot(bot, games.action_space, modules))
    observed = environments.reset(seed)
    unused = {
        name: np.zeros((games.count, space.size), space.dtype) for name, space in environments.spaces.actions.items()
    }
    for _ in range(_LOOKED_AT):
        if observed.over is not None and observed.over[0]:
            break
        observed, *_ = environments.step(unused)


def _refuse_unfit(
    games: GameEnvironments, spec: EnvironmentSpec, frames: dict[str, np.ndarray], rewards: np.ndarray
) -> None:
    for seat, agent in enumerate(games.agents):
        if not np.isfinite(rewards[seat]):
            raise EnvironmentSetupError(
                f"environment {games.name}: {agent} has the reward {rewards[seat]}: it must be finite"
            )
        for _, text in learned_reward_violations(float(rewards[seat]), spec):
            raise EnvironmentSetupError(f"environment {games.name}: {agent}: {text}")
        for name, values in frames.items():
            if unfit := unfit_number(values[seat]):
                raise EnvironmentSetupError(
                    f"environment {games.name}: {agent} observes a component {name!r} that {unfit}"
                )
