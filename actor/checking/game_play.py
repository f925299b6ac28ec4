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
    bots: Sequence[str] = (),
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
        report = report.model_copy(update=_played(environments, games, spec, seconds, env_steps, seed))
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


def _played(
    environments: TransformedEnvironment,
    games: GameEnvironments,
    spec: EnvironmentSpec,
    seconds: float,
    env_steps: int,
    seed: int,
) -> dict[str, Any]:
    """Return the fields of the report that playing tells. Raises EnvironmentSetupError for a problem."""
    random = RandomActions(environments.spaces.actions, seed)
    space = without(games.observation_space, spec.leave_out)
    batch = batch_space(games.observation_space, games.count)
    warnings: dict[str, str] = {}
    precision = [Precision(space) for _ in range(games.count)]  # of each seat
    maxima = byte_maxima(environments.spaces)
    began = time.monotonic()
    observed = environments.reset(seed)
    before, still = {name: frames.copy() for name, frames in observed.frames.items()}, StillObservations()
    reset_seconds, busy = time.monotonic() - began, 0.0
    lengths, returns, steps, length, total = [], [], 0, 0, np.zeros(games.count)
    together, differ = 0, False  # steps that show several agents something new; whether they ever observe another
    until, stepping = time.monotonic() + seconds, 0.0
    while not steps or (steps < env_steps and time.monotonic() < until):
        if steps < STEPS_FOR_MASKS and (text := _mask_warning(environments, games, observed)):
            warnings.setdefault("a mask", f"environment {spec.id}: {text}")
        chosen = random.choose_each(observed.masks, games.count)
        began, began_busy = time.monotonic(), time.process_time()
        observed, rewards, terminated, truncated = environments.step(chosen)
        stepping, busy = stepping + time.monotonic() - began, busy + time.process_time() - began_busy
        assert observed.acting is not None
        assert observed.over is not None
        steps, length, total = steps + 1, length + 1, total + rewards
        _refuse_unfit(games, spec, observed.frames, rewards)
        for name, largest in maxima.items():
            np.maximum(largest, observed.frames[name].reshape(-1, len(largest)).max(0), out=largest)
        goes_on = observed.acting & ~(terminated | truncated) & (length > 0)  # no step that only resets
        still.add({name: np.stack([frames, observed.frames[name]]) for name, frames in before.items()}, goes_on[None])
        seats = np.flatnonzero(observed.acting)
        if len(seats) > 1 and not differ:
            together += any((frames != before[name]).any() for name, frames in observed.frames.items())
            differ = any((frames[seats] != frames[seats[0]]).any() for frames in observed.frames.values())
        before = {name: frames.copy() for name, frames in observed.frames.items()}
        if steps <= _LOOKED_AT:
            for seat, row in enumerate(iterate(batch, games.observations)):
                if observed.acting[seat]:
                    precision[seat].add(row, starts=length == 0)
                    precision[seat].add_reward(rewards[seat])
                    for kind, text in observation_violations(space, row, "the game"):
                        if kind == "problem":
                            raise EnvironmentSetupError(f"environment {spec.id}: {text}")
                        warnings.setdefault(kind, f"environment {spec.id}: {text}")
        for seat in np.flatnonzero(terminated | truncated):
            if text := unreported(games.infos[seat]):
                warnings.setdefault("a number", f"environment {spec.id}: {text}")
        if observed.over[0]:
            lengths.append(length)
            returns.append(float(total.mean()))
            length, total = -1, np.zeros(games.count)  # the next step only resets
    for seen in precision:
        for name, text in seen.warnings.items():
            warnings.setdefault(
                f"precision of {name}", f"environment {spec.id}: {text.replace(_WRAPPER, 'in the game')}"
            )
    if text := still.text(len(lengths)):
        warnings["still"] = f"environment {spec.id}: {text}"
    if together >= _FEWEST_TOGETHER and not differ:
        warnings["alike"] = (
            f"environment {spec.id}: all agents that act observe the same in all of {together:,} rows, so that one "
            "policy cannot know which of them it plays: let it observe that (--set environment.agent_ids=true), unless "
            "they are to do the same"
        )
    return {
        "warnings": tuple(warnings.values()),
        "env_steps": steps,
        "step_seconds": stepping / steps,
        "busy_share": min(busy / max(stepping, 1e-9), 1.0),
        "reset_seconds": reset_seconds,
        "lengths": tuple(lengths),
        "returns": tuple(returns),
        "byte_maxima": {name: tuple(map(int, each)) for name, each in maxima.items()},
    }


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
