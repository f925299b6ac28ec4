"""Matches of a saved policy against an opponent: another policy, a version that its league kept, or a bot."""

import math
import re
import threading
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from daedalus.actor.collecting.lineup import sides_of
from daedalus.actor.environments.bots import make_bot
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.games import make_games
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.evaluation.episodes import EvaluationProgress, environments_for
from daedalus.actor.evaluation.matches import MatchPlan, MatchResults, play_matches
from daedalus.launch.evaluation_options import (
    EvaluationOptions,
    actions_of,
    check_spaces,
    environment_of,
    loaded_runtime,
    modules_of,
)
from daedalus.policy.saving.best_checkpoints import evaluation_result
from daedalus.policy.saving.hub import HubError, pull
from daedalus.policy.saving.saved_policy import NoPolicyError, SavedPolicy, find_policy
from daedalus.policy.user_code import Surroundings
from daedalus.protocol.league import is_bot, wilson_interval

_MOST_LISTED = 20
_FEW = 0.5  # share of the games that must differ from all others, unless a note says that they do not


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchScore:
    """How the games of a policy against an opponent ended. Intervals are Wilson's, at 95 %."""

    agents: tuple[str, ...]  # of the policy's side; empty for all sides together
    games: int
    wins: int
    draws: int
    losses: int
    win_interval: tuple[float, float]  # of the probability
    draw_interval: tuple[float, float]
    loss_interval: tuple[float, float]
    return_mean: float  # of the policy's agents
    opponent_return_mean: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchScores:
    """Results of a policy against an opponent, from every side of the game."""

    opponent: str  # as it was named
    opponent_checkpoint: str | None  # None of a bot
    opponent_version: int | None
    openings: int  # random env_steps at the start of each game
    distinct_games: int  # games that differ in what their agents observed
    sides: tuple[MatchScore, ...]
    total: MatchScore


def evaluated_matches(
    policy: SavedPolicy, options: EvaluationOptions, seed: int, stop: threading.Event, stream: TextIO
) -> dict[str, Any]:
    """Return the result of an evaluation with `against`; see run_evaluation. Its returns are those of the policy."""
    assert options.against is not None
    spec, modules = environment_of(policy, options), modules_of(policy, options)
    if not spec.is_game:
        raise EnvironmentSetupError(
            f"{spec.id} is no game with several agents (environment.backend=pettingzoo): leave out --against"
        )
    modules.check(spec.user_modules)
    other = None if is_bot(options.against) else _opponent(options.against, policy)
    longest, sampled = policy.spec.evaluation.max_episode_env_steps, actions_of(policy, options) == "sampled"
    progress = EvaluationProgress(stream, options.count, longest, stop)
    try:
        with Surroundings(), closing(make_games(spec, 1, modules, lambda _: _copies(policy, options) - 1)) as games:
            environments = TransformedEnvironment(games, spec)
            check_spaces(environments.spaces, spec, policy)
            sides = _sides(policy, games.agents, options.count)
            bot = partial(make_bot, options.against, games.action_space, modules, "--against")
            opponent = bot if other is None else loaded_runtime(other, stop)
            plan = MatchPlan(
                sides=sides,
                matches=options.count // len(sides),
                seed=seed,
                sampled=sampled,
                openings=options.openings,
                longest=longest,
            )
            results = play_matches(environments, plan, loaded_runtime(policy, stop), opponent, progress)
    finally:
        progress.end()
    agents = [tuple(games.agents[seat] for seat in side) for side in sides]
    scores = MatchScores(
        opponent=options.against,
        opponent_checkpoint=None if other is None else str(other.directory),
        opponent_version=None if other is None else other.policy_version,
        openings=options.openings,
        distinct_games=results.distinct,
        sides=tuple(_score(results, results.sides == side, names) for side, names in enumerate(agents)),
        total=_score(results, results.sides >= 0, ()),
    )
    notes = _notes(results, policy, other, sampled=sampled, openings=options.openings)
    returns = results.returns[:, 0]
    return {
        **evaluation_result(policy.directory, policy.policy_version, spec, returns, results.lengths, notes),
        "returns": returns.tolist(),
        "lengths": results.lengths.tolist(),
        "seed": seed,
        "actions": "sampled" if sampled else "greedy",
        "matches": scores,
    }


def _copies(policy: SavedPolicy, options: EvaluationOptions) -> int:
    """Return how many copies of the game to make; they are two sides at least, and play equally many rounds."""
    games = max(options.count // 2, 1)
    most = min(options.envs or environments_for(games, policy.spec.environment, policy.spec.collection), games)
    return math.ceil(games / math.ceil(games / most))


def _sides(policy: SavedPolicy, agents: Sequence[str], games: int) -> tuple[tuple[int, ...], ...]:
    name, sides = policy.spec.environment.id, sides_of(policy.spec.league, agents)
    if len(sides) < 2:
        raise EnvironmentSetupError(
            f"the agents of {name} are one side ({', '.join(agents[:6])}), so that there is no opponent: "
            "set league.sides in the settings of the run"
        )
    if games % len(sides):
        raise EnvironmentSetupError(
            f"--games is {games}, but {name} has {len(sides)} sides, from which equally many games are played: choose "
            f"{games - games % len(sides) or len(sides)} or {games - games % len(sides) + len(sides)}"
        )
    return sides


def _opponent(name: str, policy: SavedPolicy) -> SavedPolicy:
    """Return the policy that --against names: a kept version, a directory, or one on the Hub."""
    path = Path(name)
    if re.fullmatch(r"v[0-9]{1,19}", name) and not path.exists():
        return _kept_version(int(name[1:]), policy)
    if path.exists():
        found = find_policy(path)
    elif re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        try:
            found = find_policy(pull(name))
        except HubError as error:
            raise NoPolicyError(f"--against {name}: there is no such directory, and on the Hub: {error}") from None
    else:
        raise NoPolicyError(
            f"--against {name}: there is no such directory; name a run directory, a checkpoint, a kept version (v120), "
            "random, module:Bot, or USER/NAME on the Hub"
        )
    if found.spaces != policy.spaces:
        raise EnvironmentSetupError(
            f"--against {name}: its policy was trained on {found.spec.environment.id} with {found.spaces}, and the one "
            f"to evaluate on {policy.spec.environment.id} with {policy.spaces}: both must have the same spaces"
        )
    return found


def _score(results: MatchResults, chosen: np.ndarray, agents: tuple[str, ...]) -> MatchScore:
    games = int(chosen.sum())
    wins, draws, losses = (int((results.outcomes[chosen] == outcome).sum()) for outcome in range(3))
    own, opponents = results.returns[chosen].mean(axis=0).tolist()
    return MatchScore(
        agents=agents,
        games=games,
        wins=wins,
        draws=draws,
        losses=losses,
        win_interval=wilson_interval(wins / games, games),
        draw_interval=wilson_interval(draws / games, games),
        loss_interval=wilson_interval(losses / games, games),
        return_mean=own,
        opponent_return_mean=opponents,
    )


def _notes(
    results: MatchResults, policy: SavedPolicy, other: SavedPolicy | None, *, sampled: bool, openings: int
) -> list[str]:
    notes, games, cut = [], len(results.sides), int(results.cut.sum())
    if results.distinct <= _FEW * games:
        remedies = [] if openings else ["--openings 4 begins each with random moves"]
        remedies += [] if sampled else ["--actions sampled"]
        notes.append(
            f"only {results.distinct} of the {games} games differ, and equal ones tell nothing new: the intervals are "
            f"too narrow{': ' if remedies else ''}{', or '.join(remedies)}"
        )
    if cut:
        longest = policy.spec.evaluation.max_episode_env_steps
        notes.append(
            f"{cut} of {games} games were cut after {longest:,} env_steps (evaluation.max_episode_env_steps): their "
            "results are those of the returns until then"
        )
    if other is not None and other.spec.environment != policy.spec.environment:
        notes.append(
            f"the opponent was trained with other settings of the environment ({other.spec.environment.id}): it plays "
            "with those of the evaluated policy"
        )
    return notes


def _kept_version(policy_version: int, policy: SavedPolicy) -> SavedPolicy:
    """Return a version that the league of the policy's run kept. It has the network of the policy."""
    from daedalus.learner.league.versions import VersionFolder  # nothing else here needs code of the learner

    kept = VersionFolder(policy.directory.parent.parent / "league")
    versions = [version.policy_version for version in kept.versions()]
    if policy_version not in versions:
        listed = ", ".join(f"v{version}" for version in versions[-_MOST_LISTED:])
        raise NoPolicyError(
            f"--against v{policy_version}: the run has no such version"
            + (
                f" any more; it keeps {'..., ' if len(versions) > _MOST_LISTED else ''}{listed}"
                if versions
                else ": its league has kept none"
            )
        )
    return replace(policy, policy_version=policy_version, weights=kept.read(policy_version))
