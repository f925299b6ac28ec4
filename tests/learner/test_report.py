"""learner/reporting/run_reporter.py: metrics rows, status, summary."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from building import EPOCH, POLICY, SPACES, joined_fleet, make_rollout, run_context, run_spec
from league_statuses import LEAGUE

from daedalus.algorithms import curiosity
from daedalus.algorithms.diagnostics import VALUE_ERROR_QUANTILES
from daedalus.learner.reporting.hints import EpisodeHint
from daedalus.learner.reporting.metrics_rows import COLUMNS, Details
from daedalus.learner.reporting.rates import Rate, RateMeter, RunRates
from daedalus.learner.reporting.run_reporter import RunReporter, episode_statistics
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.run_context import Health
from daedalus.learner.training.learner import Learner
from daedalus.learner.training.update_metrics import METRICS
from daedalus.protocol.league import NEWEST, LeagueStatus, RatedPlayer, Score

DIAGNOSTICS = (
    *("behaviour_kl", "rho_mean", "rho_effective_share", "rho_clipped_fraction"),
    *VALUE_ERROR_QUANTILES,
)
EVERYTHING = np.ones((6, 3), np.bool_)


def trained_counters(*returns: float) -> RunCounters:
    """Return counters after one update from 18 env_steps with a policy lag of 2."""
    counters = RunCounters(100)
    episodes = {
        "episode_returns": np.array(returns, np.float32),
        "episode_lengths": np.full(len(returns), 7, np.int32),
    }
    rollout = make_rollout(version=3, valid=EVERYTHING, **episodes)
    counters.accepted(rollout, 180)
    counters.trained([rollout], 5, 1)
    return counters


def test_rates_are_over_ten_seconds_or_over_four_growths() -> None:
    counters = trained_counters()
    meter = RateMeter(counters, 10.0)
    assert meter.rates == RunRates()
    counters.trained([make_rollout(version=1, valid=EVERYTHING), make_rollout(version=4, valid=EVERYTHING)], 4, 1)
    expected = {"env_steps_per_second": 18.0, "updates_per_second": 0.5, "policy_lag_mean": 1.5}
    assert meter.measure(counters, joined_fleet(), 12.0) == expected
    # No rollout since, so no policy lag in the row, and the next batch is not late yet.
    assert meter.measure(counters, joined_fleet(), 13.0) == {"env_steps_per_second": 18.0, "updates_per_second": 0.5}
    assert (meter.rates.updates_per_second, meter.rates.policy_lag_mean) == (0.5, 1.5)
    assert meter.measure(counters, joined_fleet(), 18.0)["updates_per_second"] == 0.25
    assert meter.measure(counters, joined_fleet(), 99.0, is_stalled=True)["updates_per_second"] == 0.0
    for seconds in (0.5, 50.0):  # from one growth to the next
        rate = Rate(0.0, 0)
        values = [rate.add(seconds * number, 10 * number) for number in range(1, 100)]
        values += [rate.add(seconds * (99 + number), 990 + 30 * number) for number in range(1, 100)]
        assert values[:99] == pytest.approx([10 / seconds] * 99)
        assert values[-50:] == pytest.approx([30 / seconds] * 50)


def test_rates_before_the_first_batch_and_after_the_last_are_unknown_and_nothing_is_divided_by_0() -> None:
    counters = trained_counters()  # of the process before a resume
    meter = RateMeter(counters, 10.0)
    assert meter.measure(counters, joined_fleet(), 12.0) == {}
    counters.trained([make_rollout(version=1, valid=EVERYTHING)], 4, 1)
    everything = {"env_steps_per_second", "updates_per_second", "policy_lag_mean"}
    assert set(meter.measure(counters, joined_fleet(), 13.0, last=True)) == everything
    assert meter.measure(counters, joined_fleet(), 13.1, last=True) == {}
    assert RateMeter(RunCounters(100), 10.0).measure(counters, joined_fleet(), 10.0)["updates_per_second"] > 1e6


def test_a_run_without_the_end_of_an_episode_gets_a_hint_once() -> None:
    counters, fleet, hint = (
        RunCounters(100),
        joined_fleet("a", "b"),
        EpisodeHint(10**6, "limit them"),
    )  # six environments
    counters.env_steps = 59_999
    assert hint.take(counters, fleet) == ""
    counters.env_steps = 60_000
    assert hint.take(counters, fleet) == ("no episode has ended after 10,000 env_steps in each environment: limit them")
    assert hint.take(counters, fleet) == ""
    assert EpisodeHint(10**6, "").take(trained_counters(1.0), fleet) == ""
    ended = trained_counters(1.0)
    ended.env_steps = 10**9
    assert EpisodeHint(10**6, "").take(ended, fleet) == ""


def test_the_hint_comes_after_half_of_a_small_budget() -> None:
    counters, fleet = RunCounters(100), joined_fleet("a", "b")
    for budget, due, length in ((60_000, 30_000, "5,000"), (12_000, 12_000, "2,000")):
        hint = EpisodeHint(budget, "")
        counters.env_steps = due - 1
        assert hint.take(counters, fleet) == ""
        counters.env_steps = due
        assert hint.take(counters, fleet).startswith(f"no episode has ended after {length} env_steps in each")


def test_episode_statistics_are_over_the_newest_episodes() -> None:
    assert episode_statistics(RunCounters(3)) == {}
    assert episode_statistics(trained_counters(1.0, 2.0, 6.0)) == pytest.approx(
        {
            "episode_return_mean": 3.0,
            "episode_return_std": np.std([1.0, 2.0, 6.0]),
            "episode_return_min": 1.0,
            "episode_return_max": 6.0,
            "episode_length_mean": 7.0,
        }
    )


def learner_with(metrics: dict[str, float]) -> Any:
    """Return a learner that has made updates with these metrics."""
    return SimpleNamespace(
        metrics=SimpleNamespace(take_means=lambda: metrics),
        take_diagnostics=dict,
        learning_rate=lambda progress: 0.1,
        entropy_bonus=lambda progress: 0.2,
    )


def test_row_has_every_column_when_all_values_are_known() -> None:
    counters, fleet = trained_counters(4.0), joined_fleet("a", "b")
    counters.rollouts_rejected.update({"stale": 2, "malformed": 1})
    fleet.set_present("b", 1, False, 0.0)
    context = run_context(counters=counters, fleet=fleet, started=1.5)
    reporter = RunReporter(context, UserMetrics())
    counters.trained([make_rollout(version=3, valid=EVERYTHING)], 5, 1)
    context.evaluations.newest = {name: 1.0 for name in COLUMNS if name.startswith("evaluation_")}
    row = reporter.row(learner_with(dict.fromkeys((*METRICS, *DIAGNOSTICS, *curiosity.METRICS), 0.5)), 11.0)
    assert set(row) == set(COLUMNS) - {"agent_steps", "rating", "rating_deviation"}  # of games only
    assert (row["wall_seconds"], row["env_steps"], row["updates"]) == (9.5, 36, 2)
    assert (row["actors"], row["rollouts_rejected"], row["policy_lag_max"]) == (1, 3, 2)


def test_row_status_and_summary_have_the_league_of_a_game_with_opponents() -> None:
    league = LEAGUE.model_copy(update={"players": (*LEAGUE.players, *(_version(number) for number in range(300, 400)))})
    reporter = RunReporter(run_context(league=SimpleNamespace(status=lambda: league)), UserMetrics())
    row = reporter.row(learner_with({}), 0.0)
    assert {
        name: row[name] for name in ("rating", "rating_deviation", "win_rate/random", "win_rate/my_bots.Greedy")
    } == {
        "rating": 1312.5,
        "rating_deviation": 50.0,
        "win_rate/random": 0.97,
        "win_rate/my_bots.Greedy": 0.75,
    }
    shown = reporter.status(0, 0.0).league
    assert shown is not None
    assert (len(shown.players), shown.left_out) == (24, 82)
    summary = reporter.summary(finished=True, now=0.0)
    assert LeagueStatus.model_validate(json.loads(json.dumps(summary))["league"]) == shown
    assert "league" not in RunReporter(run_context(), UserMetrics()).summary(finished=True, now=0.0)
    names = [f"bots:Bot{number}" for number in range(30)]
    players = [RatedPlayer(player=name, rating=0.0, deviation=1.0) for name in (NEWEST, *names)]
    league = LeagueStatus(
        players=tuple(players), scores=tuple(Score(first=NEWEST, second=name, wins=1.0) for name in names)
    )
    assert sum(name.startswith("win_rate/") for name in reporter.row(learner_with({}), 0.0)) == 30


def _version(number: int) -> RatedPlayer:
    return RatedPlayer(player=f"v{number}", rating=1.0, deviation=1.0)


def test_first_row_omits_unknown_values() -> None:
    row = RunReporter(run_context(), UserMetrics()).row(learner_with({}), 0.0)
    assert set(row) < set(COLUMNS)
    assert "episode_return_mean" not in row


def test_status_contains_the_run_and_each_actor() -> None:
    counters, fleet = trained_counters(4.0), joined_fleet("a", "b")
    spec = run_spec(algorithm="a3c", env_steps=1000)
    health = Health(started=10.0, updated=24.0, actor_seen=24.0, saved=20.0, certificate_days_left=lambda: 7.5)
    context = run_context(spec, Path("run"), counters=counters, fleet=fleet, health=health)
    status = RunReporter(context, UserMetrics()).status(77, 25.0)
    assert (status.run, status.learner_epoch, status.algorithm, status.environment) == ("run", EPOCH, "a3c", "Any-v0")
    assert (status.uptime_seconds, status.env_steps, status.env_steps_budget) == (15.0, 18, 1000)
    assert (status.episode_return_mean, status.env_steps_per_second) == (4.0, 0.0)
    assert (status.problems, status.checkpoint_age_seconds, status.certificate_days_left) == ((), 5.0, 7.5)
    assert (status.queue_bytes, status.queue_bytes_limit) == (77, 64 * 2**20)
    assert [actor.actor for actor in status.actors] == ["a", "b"]


HEALTHY = Health(started=0.0, updated=100.0, actor_seen=100.0)


@pytest.mark.parametrize(
    ("changed", "live", "problems"),
    [
        ({}, 2, ()),
        ({"actor_seen": 97.0}, 0, ()),
        ({"actor_seen": 90.0}, 0, ("no live actor for 15 s",)),
        ({"actor_seen": 90.0}, 1, ()),
        ({"updated": 44.0, "awaited_since": 44.0}, 1, ("no update for 61 s",)),
        ({"updated": 44.0, "actor_seen": 44.0}, 0, ("no live actor for 61 s",)),
        ({"gradient_fault": True}, 1, ("updates are skipped: the gradient is not finite",)),
        (
            {"left_out": {"b", "a"}},
            3,
            ("batches do not wait for a, b: connected, but far slower than the others, or hung",),
        ),
        (
            {"left_out": set("abcdefg")},
            9,
            ("batches do not wait for a, b, c, d, e and 2 more: connected, but far slower than the others, or hung",),
        ),
        (
            {"far_outside": {"b": ("returns", 50.0), "a": ("observations/position", 60.0), "c": ("returns", 44.0)}},
            3,
            ("rollouts with numbers far outside those of other actors: a (observations/position), b (returns)",),
        ),
        ({"save_fault": "No space left"}, 1, ("checkpoints cannot be saved: No space left",)),
    ],
)
def test_problems_describe_an_unhealthy_service(changed: dict[str, Any], live: int, problems: tuple[str, ...]) -> None:
    assert dataclasses.replace(HEALTHY, **changed).problems(105.0, live) == problems


def test_measure_sets_the_rate_of_each_actor() -> None:
    counters, fleet = trained_counters(), joined_fleet("a", "b")
    meter = RateMeter(counters, 10.0)
    fleet.actors["a"].env_steps = 40
    meter.measure(counters, fleet, 12.0)
    assert [fleet.actors[name].env_steps_per_second for name in ("a", "b")] == [20.0, 0.0]
    fleet.set_present("a", 1, False, 12.5)
    meter.measure(counters, fleet, 13.0)
    assert fleet.actors["a"].env_steps_per_second == 0.0


def test_summary_is_json_and_contains_bytes_per_env_step() -> None:
    counters = trained_counters(4.0)
    counters.seconds_to_target = 3.5
    context = run_context(run_spec(algorithm="a3c", seed=4), counters=counters)
    made = RunReporter(context, UserMetrics()).summary(finished=True, now=4.5)
    assert json.loads(json.dumps(made)) == made
    assert made["rollout_bytes_per_env_step"] == 10.0
    assert (made["solved"], made["seconds_to_target"], made["seed"]) == (True, 3.5, 4)
    assert (made["policy_lag_mean"], made["policy_lag_max"], made["episode_return_mean"]) == (2.0, 2, 4.0)


def test_summary_of_an_empty_run_does_not_divide_by_0() -> None:
    context = run_context(started=0.0, health=HEALTHY)
    made = RunReporter(context, UserMetrics()).summary(finished=False, now=0.0)
    assert made["rollout_bytes_per_env_step"] == 0.0
    assert (made["solved"], made["seconds_to_target"], made["episode_return_mean"]) == (False, None, None)


def test_distributions_come_every_ten_seconds_and_with_the_last_row() -> None:
    context, recorded = run_context(), list[Details]()
    learner = Learner(context.spec.training, POLICY, SPACES)
    recorder: Any = SimpleNamespace(record=lambda row, details: recorded.append(details))
    reporter = RunReporter(context, UserMetrics())
    reporter.begin(recorder, 0.0)
    context.counters.returns.append(2.0)
    counted = []
    for now, last in ((0.5, False), (1.0, False), (10.4, False), (10.5, False), (11.0, False), (11.5, True)):
        learner.step([make_rollout(valid=EVERYTHING)], 0.0)
        context.counters.lengths.append(7)
        reporter.record(learner, now, last=last)
        counted.append(sum(recorded[-1].action_counts.get("action", ())))
        assert list(recorded[-1].returns) == ([2.0] if counted[-1] else [])
    assert counted == [18, 0, 0, 3 * 18, 0, 2 * 18]
