"""learner/league/ratings.py and the thinning of kept versions: pure."""

import math
import random
import time
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daedalus.learner.league.ratings import LeagueState, Ratings
from daedalus.learner.league.versions import KeptVersion, thinned
from daedalus.protocol.league import NEWEST, MatchCount, Purpose, RatedPlayer
from daedalus.protocol.spec import LeagueSpec


def count(first: str, second: str, results: Sequence[int], purpose: Purpose = "rating", side: int = 0) -> MatchCount:
    wins, draws, losses = results
    return MatchCount(purpose=purpose, first=first, second=second, side=side, wins=wins, draws=draws, losses=losses)


def played(ratings: Ratings, first: str, second: str, *results: int) -> None:
    ratings.add([count(first, second, results)], rate_training=True)


def of(ratings: Ratings, player: str) -> RatedPlayer:
    return next(each for each in ratings.status().players if each.player == player)


def test_one_match_by_hand() -> None:
    """Equal ratings: p is 1/2, so that the winner moves by deviation^2 / c / 2. Weng & Lin, algorithm 1."""
    ratings = Ratings(["a:B"])
    played(ratings, NEWEST, "a:B", 1, 0, 0)
    c = math.sqrt(2 * 350.0**2 + (400.0 / math.log(10.0)) ** 2)
    assert of(ratings, NEWEST).rating == pytest.approx(350.0**2 / c / 2.0)
    assert of(ratings, "a:B").rating == pytest.approx(-(350.0**2) / c / 2.0)
    assert of(ratings, NEWEST).deviation == pytest.approx(350.0 * math.sqrt(1.0 - (350.0 / c) ** 2 / 4.0))


def test_the_scale_is_elos_and_random_is_its_zero() -> None:
    ratings, luck = Ratings(["a:B", "random"]), random.Random(1)
    for _ in range(1500):
        results = (1, 0, 0) if luck.random() < 0.76 else (0, 0, 1)
        played(ratings, "a:B", "random", *results)
    assert (of(ratings, "random").rating, of(ratings, "random").deviation) == (0.0, 0.0)
    bot = of(ratings, "a:B")
    assert 10.0 < bot.deviation < 30.0
    assert abs(bot.rating - 200.0) < 3.0 * bot.deviation
    assert ratings.win_probability("a:B", "random") == pytest.approx(0.76, abs=0.05)


def test_a_version_has_the_rating_of_the_newest_policy_but_not_its_results() -> None:
    ratings = Ratings(["random"])
    played(ratings, NEWEST, "random", 300, 0, 100)
    newest = of(ratings, NEWEST)
    assert newest.deviation == 50.0  # it changes: it is never surer
    ratings.keep(7)
    assert (of(ratings, "v7").rating, of(ratings, "v7").deviation) == (newest.rating, 100.0)
    assert of(ratings, "v7").matches == 0
    assert [(each.first, each.second) for each in ratings.status().scores] == [(NEWEST, "random")]


def test_without_random_the_first_version_is_the_zero() -> None:
    ratings = Ratings(["a:B"])
    ratings.keep(0)
    played(ratings, "v0", "a:B", 0, 0, 5)
    assert (of(ratings, "v0").rating, of(ratings, "v0").deviation) == (0.0, 0.0)
    assert of(ratings, "a:B").rating > 100.0


def test_old_results_of_the_newest_policy_count_less() -> None:
    ratings = Ratings(["a:B"])
    played(ratings, NEWEST, "a:B", 0, 0, 1000)
    played(ratings, "a:B", NEWEST, 0, 0, 400)
    (score,) = ratings.status().scores
    assert (score.first, score.second) == (NEWEST, "a:B")
    assert score.wins + score.losses == pytest.approx(200.0, abs=1.0)
    assert score.losses == pytest.approx(200.0 * (1 - 1 / 200) ** 400, rel=0.02)
    assert of(ratings, NEWEST).matches == 1400


def test_a_cycle_is_in_the_results_and_not_in_the_ratings() -> None:
    """Rock, paper, scissors: each beats one and loses to one."""
    ratings = Ratings(["a:Rock", "a:Paper", "a:Scissors"])
    cycle = [("a:Paper", "a:Rock"), ("a:Scissors", "a:Paper"), ("a:Rock", "a:Scissors")]
    for _ in range(40):
        for winner, loser in cycle:
            played(ratings, winner, loser, 1, 0, 0)
    for winner, loser in cycle:
        assert abs(of(ratings, winner).rating - of(ratings, loser).rating) < 60.0
        assert ratings.win_rate(winner, loser) > 0.85
        assert ratings.win_rate(loser, winner) == pytest.approx(1.0 - ratings.win_rate(winner, loser))


def test_prioritized_opponents_are_those_that_win_about_half() -> None:
    ratings = Ratings(["random", "a:B"])
    for version in (0, 1, 2):
        ratings.keep(version)
    played(ratings, NEWEST, "v0", 190, 0, 10)
    played(ratings, NEWEST, "v1", 150, 0, 50)
    played(ratings, NEWEST, "v2", 50, 100, 50)
    fixed = {"random": 0.0, "a:B": 0.1}
    plan = {each.player: each.weight for each in ratings.training_plan(0.3, fixed, prioritized=True)}
    assert plan.keys() == {"v0", "v1", "v2", "a:B"}
    assert plan["v0"] < plan["v1"] / 2 < plan["v2"]
    assert sum(plan.values()) == pytest.approx(0.4, abs=0.02)
    uniform = {each.player: each.weight for each in ratings.training_plan(0.3, fixed, prioritized=False)}
    assert uniform == {"v0": 0.1, "v1": 0.1, "v2": 0.1, "a:B": 0.1}
    exact = ratings.training_plan(0.0, {"random": 0.115, "a:B": 0.125}, prioritized=False)
    assert {each.player: each.weight for each in exact} == {"random": 0.115, "a:B": 0.125}


def test_rating_matches_are_those_that_tell_most() -> None:
    ratings = Ratings(["random"])
    for version in range(12):
        ratings.keep(version)
        for other in range(version):  # all but the last are well known; each is 30 points stronger than the one before
            if version < 11:
                played(ratings, f"v{version}", f"v{other}", *(60 + 4 * (version - other), 0, 40))
    assert ratings.gain("v11", "v10") > 10 * ratings.gain("v9", "v10")
    plan = {(each.first, each.second): each.weight for each in ratings.rating_plan(["random"])}
    others = {pair: weight for pair, weight in plan.items() if pair != (NEWEST, "random")}
    assert plan[NEWEST, "random"] >= 0.5  # people look at it
    assert all(
        "v11" in pair or NEWEST in pair or "random" in pair
        for pair in sorted(others, key=lambda pair: others[pair])[-3:]
    )
    unequal = Ratings(["random", "a:Strong"])
    played(unequal, "a:Strong", "random", 380, 0, 20)
    unequal.keep(0)
    assert unequal.gain("v0", "random") > 1.2 * unequal.gain("v0", "a:Strong")


@pytest.mark.parametrize(
    ("results", "reached"),
    [((30, 0, 0), False), ((80, 0, 20), False), ((170, 0, 30), True), ((150, 40, 10), True), ((300, 0, 90), False)],
)
def test_a_target_needs_many_matches_and_the_lower_end_of_the_interval(
    results: tuple[int, int, int], reached: bool
) -> None:
    ratings = Ratings(["random"])
    played(ratings, NEWEST, "random", *results)
    assert ratings.reach(LeagueSpec(target_opponent="random", target_win_rate=0.75)) == reached
    assert not ratings.reach(LeagueSpec())


def test_a_rating_is_reached_two_deviations_above_it() -> None:
    ratings = Ratings(["random"])
    played(ratings, NEWEST, "random", 380, 0, 20)
    rating = of(ratings, NEWEST).rating
    assert ratings.reach(LeagueSpec(target_rating=rating - 101.0))
    assert not ratings.reach(LeagueSpec(target_rating=rating - 99.0))


def test_matches_of_a_dropped_version_still_rate_the_other_player() -> None:
    ratings = Ratings(["random"])
    ratings.keep(0)
    ratings.keep(5)
    ratings.retire("v5")
    before = of(ratings, NEWEST)
    played(ratings, NEWEST, "v5", 3, 0, 0)
    assert of(ratings, NEWEST).rating > before.rating
    assert (of(ratings, NEWEST).matches, ratings.ignored) == (3, 0)
    played(ratings, NEWEST, "v99", 2, 1, 0)  # of a learner before this one
    assert (of(ratings, NEWEST).matches, ratings.ignored) == (3, 3)
    assert ratings.is_known("v99")
    assert not any(map(ratings.is_known, ("v01", "v-1", "Newest", "a:B", "")))


def test_training_matches_do_not_rate_greedy_players() -> None:
    ratings = Ratings(["random"])
    counts = [count(NEWEST, "random", (5, 0, 0), "training"), count(NEWEST, "random", (0, 0, 2))]
    ratings.add(counts, rate_training=False)
    assert (of(ratings, NEWEST).matches, of(ratings, NEWEST).rating < 0.0) == (2, True)


def test_very_many_results_take_little_time() -> None:
    ratings = Ratings(["random"])
    began = time.process_time()
    played(ratings, NEWEST, "random", 10**15, 1, 10**15)
    assert time.process_time() - began < 1.0
    assert abs(of(ratings, NEWEST).rating) < 100.0


def test_fixed_opponents_that_are_removed_from_the_settings_are_retired() -> None:
    ratings = Ratings(["random", "a:B"])
    played(ratings, "a:B", "random", 9, 0, 1)
    rating = of(ratings, "a:B").rating
    without = Ratings(["random"], ratings.state())
    assert without.players == [NEWEST, "random"]
    again = Ratings(["random", "a:B"], LeagueState.model_validate(without.state().model_dump(mode="json")))
    assert of(again, "a:B").rating == pytest.approx(rating)


names = st.sampled_from([NEWEST, "random", "a:B", *(f"v{version}" for version in range(6))])
operations = st.one_of(
    st.tuples(st.just("keep"), st.integers(0, 5)),
    st.tuples(st.just("retire"), st.integers(0, 5)),
    st.tuples(st.just("add"), names, names, st.lists(st.integers(0, 9), min_size=3, max_size=3)),
)


@given(st.lists(operations, max_size=30), st.booleans())
def test_no_result_is_lost_and_plans_have_players_of_the_league_only(
    done: list[tuple],
    prioritized: bool,  # type: ignore[type-arg]
) -> None:
    ratings, matches = Ratings(["random", "a:B"]), 0
    for kind, *arguments in done:
        if kind == "keep":
            ratings.keep(arguments[0])
        elif kind == "retire":
            ratings.retire(f"v{arguments[0]}")
        else:
            played(ratings, arguments[0], arguments[1], *arguments[2])
            matches += sum(arguments[2])
    restored = Ratings(["random", "a:B"], LeagueState.model_validate(ratings.state().model_dump(mode="json")))
    assert restored.state() == ratings.state()
    state = ratings.state()
    assert sum(each.matches for each in (*state.players, *state.retired)) + 2 * ratings.ignored <= 2 * matches
    training = ratings.training_plan(0.2, {"random": 0.1, "a:B": 0.0}, prioritized=prioritized)
    assert {each.player for each in training} == {"random", *(f"v{version}" for version in ratings.versions)}
    assert sum(each.weight for each in training) == pytest.approx(0.3 if ratings.versions else 0.1, rel=0.05)
    rating = ratings.rating_plan(["random", "a:B"])
    assert {name for each in rating for name in (each.first, each.second)} <= {*ratings.players}
    assert all(each.first != each.second for each in rating)
    assert sum(each.weight for each in rating) == pytest.approx(1.0, abs=0.1)


@given(st.lists(st.integers(1, 50), min_size=1, max_size=80), st.integers(1, 12))
def test_thinning_keeps_the_first_and_the_newest(steps: list[int], most: int) -> None:
    kept: list[KeptVersion] = []
    for number, _ in enumerate(steps):
        kept = thinned([*kept, KeptVersion(number, sum(steps[:number]))], most)
        assert len(kept) <= most
        assert kept[-1].policy_version == number
        assert most == 1 or kept[0].policy_version == 0


def test_versions_that_are_kept_regularly_stay_at_even_distances() -> None:
    kept: list[KeptVersion] = []
    for number in range(300):
        kept = thinned([*kept, KeptVersion(number, 1000 * number)], 10)
        distances = [after.env_steps - before.env_steps for before, after in pairwise(kept[:-1])]
        assert not distances or max(distances) <= 3 * min(distances), kept
