"""Test of launch/prometheus_exporter.py."""

import time
from collections.abc import Iterable

import pytest
from league_statuses import LEAGUE
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import Metric
from prometheus_client.parser import text_string_to_metric_families
from statuses import actor_status, run_status

from daedalus.launch.prometheus_exporter import CertificateDays, metrics
from daedalus.protocol.messages import RunStatus

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


class FixedCollector:
    def __init__(self, statuses: Iterable[RunStatus]) -> None:
        self.statuses = statuses

    def collect(self) -> Iterable[Metric]:
        return metrics(self.statuses)


def scraped(*statuses: RunStatus) -> Samples:
    """Return what Prometheus reads, by name and labels. A duplicate series fails."""
    registry = CollectorRegistry()
    registry.register(FixedCollector(statuses))
    samples: Samples = {}
    for family in text_string_to_metric_families(generate_latest(registry).decode()):
        for sample in family.samples:
            key = (sample.name, tuple(sorted(sample.labels.items())))
            assert key not in samples
            samples[key] = sample.value
    return samples


def value(samples: Samples, name: str, **labels: str) -> float | None:
    return samples.get((name, tuple(sorted(labels.items()))))


def test_only_daedalus_up_is_exported_if_no_learner_answers() -> None:
    assert scraped() == {("daedalus_up", ()): 0.0}


def test_the_values_of_a_run_and_its_actors_are_exported() -> None:
    samples = scraped(run_status(actors=(actor_status("a", env_steps=40), actor_status("b", env_steps=60))))
    assert value(samples, "daedalus_up") == 1.0
    assert value(samples, "daedalus_run_info", run="mine", environment="CartPole-v1", algorithm="impala") == 1.0
    assert value(samples, "daedalus_healthy", run="mine") == 1.0
    assert value(samples, "daedalus_env_steps_total", run="mine") == 100.0
    assert value(samples, "daedalus_updates_total", run="mine") == 7.0
    assert value(samples, "daedalus_rollouts_rejected_total", run="mine", cause="stale") == 2.0
    assert value(samples, "daedalus_actor_env_steps_total", run="mine", actor="b") == 60.0
    assert value(samples, "daedalus_actor_up_bytes_per_second", run="mine", actor="b") == 2.0
    assert value(samples, "daedalus_actors", run="mine", state="alive") == 2.0


def test_the_rating_and_the_win_rates_of_a_game_are_exported() -> None:
    samples = scraped(run_status(league=LEAGUE))
    assert value(samples, "daedalus_rating", run="mine") == 1312.5
    assert value(samples, "daedalus_win_rate", run="mine", opponent="random") == 0.97
    assert value(samples, "daedalus_win_rate", run="mine", opponent="my_bots:Greedy") == 0.75


def test_an_unknown_value_has_no_sample() -> None:
    samples = scraped(run_status(episode_return_mean=None, checkpoint_age_seconds=None))
    assert value(samples, "daedalus_rating", run="mine") is None
    assert value(samples, "daedalus_episode_return_mean", run="mine") is None
    assert value(samples, "daedalus_checkpoint_age_seconds", run="mine") is None


def test_the_certificate_of_a_learner_is_exported_after_the_learner_has_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A learner ends when its certificate expires: the gauge then goes below 0, and disappears a week later."""
    days, now = CertificateDays([], None), time.monotonic()

    def seen(days_later: float, *statuses: RunStatus) -> dict[str, float]:
        monkeypatch.setattr(time, "monotonic", lambda: now + days_later * 86_400)
        return {sample.labels["run"]: round(sample.value, 3) for sample in days.metric(statuses).samples}

    assert seen(0.0, run_status(certificate_days_left=None)) == {}
    assert seen(0.0, run_status(certificate_days_left=1.5)) == {"mine": 1.5}
    assert seen(1.0) == {"mine": 0.5}
    assert seen(5.0) == {"mine": -3.5}
    assert seen(7.1) == {}
    assert seen(7.2, run_status(certificate_days_left=365.0)) == {"mine": 365.0}


def test_a_run_with_a_problem_is_not_healthy() -> None:
    samples = scraped(run_status(problems=("no update for 70 s",)))
    assert value(samples, "daedalus_healthy", run="mine") == 0.0
    assert value(samples, "daedalus_up") == 1.0


@pytest.mark.parametrize(("alive", "quarantined", "state"), [(False, "", "gone"), (True, "unfit", "quarantined")])
def test_actors_are_counted_by_state(alive: bool, quarantined: str, state: str) -> None:
    samples = scraped(run_status(actors=(actor_status("a"), actor_status("b", alive=alive, quarantined=quarantined))))
    counts = {each: value(samples, "daedalus_actors", run="mine", state=each) for each in ("alive", state)}
    assert counts == {"alive": 1.0, state: 1.0}


def test_an_actor_that_is_gone_has_no_series() -> None:
    samples = scraped(run_status(actors=(actor_status("a"), actor_status("b", alive=False))))
    assert {labels["actor"] for _, each in samples if "actor" in (labels := dict(each))} == {"a"}


def test_two_runs_are_exported_and_a_run_that_answers_twice_only_once() -> None:
    samples = scraped(run_status(), run_status(run="other", updates=9), run_status(run="other", updates=9))
    assert value(samples, "daedalus_updates_total", run="mine") == 7.0
    assert value(samples, "daedalus_updates_total", run="other") == 9.0


def test_label_values_from_the_network_are_escaped() -> None:
    nasty = 'a"} 1\nevil_total{x="'
    assert value(scraped(run_status(environment=nasty)), "daedalus_run_info", **_info(nasty)) == 1.0


def _info(environment: str) -> dict[str, str]:
    return {"run": "mine", "environment": environment, "algorithm": "impala"}


def test_of_two_learners_of_one_run_the_newer_has_series() -> None:
    samples = scraped(run_status(learner_epoch=2, updates=20), run_status(learner_epoch=1, updates=10))
    assert value(samples, "daedalus_learners", run="mine") == 2.0
    assert value(samples, "daedalus_updates_total", run="mine") == 20.0
