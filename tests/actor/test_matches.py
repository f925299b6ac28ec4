"""Matches against an opponent: who plays which side, how they are counted, and what their results depend on."""

from typing import Any

import numpy as np
import pytest
import scripted_games
from hypothesis import given, settings
from hypothesis import strategies as st
from plain import Always

from daedalus.actor.environments.games import make_games
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.evaluation.matches import MatchPlan, MatchResults, play_matches
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.league import wilson_interval
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, TrainingSpec

MODULES = UserModules(frozenset({"scripted_games"}))


class AlwaysBot:
    """A bot that takes action 3 always."""

    def reset(self, agent: str, seed: int) -> None:
        """See Bot."""

    def act(self, observation: Any, action_mask: Any) -> int:
        return 3


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    sides=st.sampled_from([((0,), (1,)), ((0, 2), (1, 3)), ((0,), (1,), (2,)), ((1,), (0,))]),
    copies=st.integers(1, 3),
    matches=st.integers(1, 5),
    kind=st.sampled_from(["Turns", "Together"]),
    is_bot=st.booleans(),
    openings=st.sampled_from([0, 0, 100]),
)
def test_outcomes_are_those_of_a_slow_account(
    seed: int,
    sides: tuple[tuple[int, ...], ...],
    copies: int,
    matches: int,
    kind: str,
    is_bot: bool,
    openings: int,
) -> None:
    agents = sum(map(len, sides))
    spec = EnvironmentSpec(id=f"scripted_games:{kind}", backend="pettingzoo", kwargs={"seed": seed, "agents": agents})
    first_copy = scripted_games.Scripted.made
    environments = TransformedEnvironment(make_games(spec, copies, MODULES), spec)
    scripted_games.PLAYED.clear()
    opponent = AlwaysBot if is_bot else Always(3)
    plan = MatchPlan(sides=sides, matches=matches, seed=1, sampled=False, openings=openings, longest=1000)
    results = play_matches(environments, plan, Always(4), opponent)
    environments.close()
    number, at = 0, 0  # a copy's matches have numbers, from that of the reset when it is made
    for side, members in enumerate(sides):
        for first in range(0, matches, copies):
            number += 1
            account = scripted_games.rows(seed, number, agents, together=kind == "Together")
            returns = scripted_games.totals(seed, number, agents, together=kind == "Together")
            means = [np.mean([returns[agent] for agent in each]) for each in sides]
            own, best = means[side], max(mean for each, mean in enumerate(means) if each != side)
            for copy in range(min(copies, matches - first)):
                assert results.sides[at] == side
                assert results.outcomes[at] == (0 if own > best else 1 if own == best else 2)
                others = [returns[agent] for agent in range(agents) if agent not in members]
                assert results.returns[at].tolist() == pytest.approx([own, np.mean(others)])
                assert results.lengths[at] == len({row.step for row in account.values()})
                for key in account:
                    played = scripted_games.PLAYED[first_copy + copy, key]
                    assert openings or played == (4 if key[1] in members else 3)
                at += 1
    assert at == len(results.sides) == matches * len(sides)
    assert not results.cut.any()
    if openings and len(scripted_games.PLAYED) > 60:  # then neither player has acted
        assert set(scripted_games.PLAYED.values()) == set(range(5))


def tic_tac_toe(copies: int, matches: int, bot: type[AlwaysBot] | None = None, **options: Any) -> MatchResults:
    """Let a policy play against itself, or against a bot."""
    spec = EnvironmentSpec(id="pettingzoo.classic.tictactoe_v3")
    environments = TransformedEnvironment(make_games(spec, copies, MODULES), spec)
    learner = Learner(TrainingSpec(), PolicySpec(hidden=(8,)), environments.spaces)
    runtime = OnnxRuntime(learner.program())
    runtime.load(learner.weights())
    try:
        plan = MatchPlan(sides=((0,), (1,)), matches=matches, seed=7, **options)
        return play_matches(environments, plan, runtime, bot or runtime)
    finally:
        environments.close()


@pytest.mark.parametrize(("sampled", "openings"), [(True, 0), (False, 3)])
def test_results_do_not_depend_on_the_number_of_copies(sampled: bool, openings: int) -> None:
    one, several = (tic_tac_toe(copies, 7, sampled=sampled, openings=openings) for copies in (1, 3))
    for name in ("sides", "outcomes", "returns", "lengths", "distinct"):
        assert np.array_equal(getattr(one, name), getattr(several, name)), name
    assert one.distinct > 7


@pytest.mark.parametrize(("bot", "openings"), [(None, 3), (AlwaysBot, 9)])
def test_both_sides_have_the_same_openings(bot: type[AlwaysBot] | None, openings: int) -> None:
    results = tic_tac_toe(2, 20, bot, sampled=False, openings=openings)
    as_first, as_second = results.outcomes[:20], results.outcomes[20:]
    assert as_first.tolist() == (2 - as_second).tolist()
    assert results.lengths[:20].tolist() == results.lengths[20:].tolist()
    assert len(set(as_first.tolist())) > 1


def test_the_games_of_two_players_without_chance_are_equal() -> None:
    assert tic_tac_toe(2, 5, sampled=False).distinct == 2


def test_long_games_are_cut() -> None:
    results = tic_tac_toe(2, 2, sampled=False, longest=4)
    assert results.cut.all()
    assert results.outcomes.tolist() == [1] * 4
    assert results.lengths.tolist() == [4] * 4
    assert results.distinct == 2


@pytest.mark.parametrize(("count", "total"), [(0, 100), (3, 10), (50, 100), (100, 100), (0.5, 2.5)])
def test_the_interval_ends_where_the_sample_is_two_deviations_away(count: float, total: float) -> None:
    low, high = wilson_interval(count / total, total)
    for bound in (low, high):
        deviation = np.sqrt(bound * (1 - bound) / total)
        assert bound in (0.0, 1.0) or abs(count / total - bound) == pytest.approx(1.959964 * deviation)
    assert low <= count / total <= high
    assert (low == 0.0, high == 1.0) == (count == 0, count == total)


def test_the_interval_is_that_of_newcombe() -> None:
    """Newcombe (1998), table I, method 3."""
    assert wilson_interval(81 / 263, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(0.0, 0.0) == (0.0, 1.0)
