"""Health, rates and the bottleneck of slow simulators, in virtual time: what a learner reports every ten seconds."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import pytest
from building import joined_fleet, make_rollout, run_context, run_spec

from daedalus.actor.session.uploading import ACTOR_PAUSE_SECONDS, Pace, Reports
from daedalus.launch.prometheus_exporter import metrics
from daedalus.learner.reporting.run_reporter import RunReporter
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import CLIENT_REPORT_LIMITS
from daedalus.protocol.messages import ClientReport, RunStatus

_TICK = 0.1


@dataclass
class Simulator:
    """An actor whose environment takes its time for a row. An actor of an older release `reports` nothing."""

    name: str
    row_seconds: float
    rows: int
    reports: bool = True
    trip_seconds: float = 0.0  # of a request
    hangs_at: float = float("inf")
    now: float = 0.0
    row: int = 0  # of the rollout that is being played
    is_done: bool = False  # it waits until its rollout is learned from
    pace: Pace = field(default_factory=Pace)

    def __post_init__(self) -> None:
        self._messages = Reports(
            lambda: self.pace.added_to(ClientReport(actor=self.name, incarnation=1), self.now), ACTOR_PAUSE_SECONDS
        )
        self._next_row = 0.0
        self.pace.join(self.rows)
        self.pace.begin_rollout(0.0)

    def go_on(self, now: float) -> Iterator[ClientReport]:
        """Play until a time, and yield what is reported."""
        self.now = now
        while not self.is_done and self._next_row <= now < self.hangs_at:
            if self.row == self.rows:
                self.is_done = True
                self.pace.end_rollout(self._next_row)
                break
            self.pace.begin_row(self._next_row)
            self.row, self._next_row = self.row + 1, self._next_row + self.row_seconds
            yield from self._due(repeats=False)
        if self.is_done:
            yield from self._due(repeats=True)

    def _due(self, *, repeats: bool) -> Iterator[ClientReport]:
        for query in self._messages.take_due("r", self.now, repeats=repeats) if self.reports else ():
            report = decode(query.payload, CLIENT_REPORT_LIMITS)
            assert isinstance(report, ClientReport)
            yield report
            query.on_answer(b"", self.now + self.trip_seconds)

    def learned_from(self, now: float) -> None:
        """Begin the next rollout."""
        self.is_done, self.row, self._next_row = False, 0, now
        self.pace.begin_rollout(now)


class _NoLearner:
    """Has no metrics."""

    metrics = SimpleNamespace(take_means=dict)
    take_diagnostics = staticmethod(dict)
    learning_rate = entropy_bonus = staticmethod(lambda progress: 0.1)


@dataclass
class Run:
    """A learner of some simulators, which learns for `update_seconds` from each batch."""

    simulators: list[Simulator]
    algorithm: str = "a3c"
    update_seconds: float = 0.01

    def looks(self, seconds: float, every: float = 10.0) -> Iterator[tuple[float, RunStatus]]:
        """Let time pass; yield the time and the status again and again."""
        names = [each.name for each in self.simulators]
        spec = run_spec(rows=self.simulators[0].rows, actors=len(names), algorithm=self.algorithm)
        context = run_context(spec, fleet=joined_fleet(*names), started=0.0)
        context.health.started = context.health.updated = context.health.awaited_since = context.health.actor_seen = 0.0
        reporter, learner = RunReporter(context, UserMetrics()), cast(Any, _NoLearner())
        free_at = 0.0  # when the learner has computed its last update
        for tick in range(1, round(seconds / _TICK) + 1):
            now = tick * _TICK
            for simulator in self.simulators:
                for report in simulator.go_on(now):
                    context.fleet.report(simulator.name, report, now)
            done = [each for each in self.simulators if each.is_done]
            is_complete = len(done) == len(names) if spec.algorithm.synchronous else bool(done)
            if is_complete and free_at <= now:
                batch = done if spec.algorithm.synchronous else done[:1]
                for each in batch:
                    context.fleet.actors[each.name].heard(now)
                    context.fleet.actors[each.name].env_steps += 100
                context.counters.trained([make_rollout(version=0) for _ in batch], 0, 1)
                context.counters.learning_seconds += self.update_seconds
                free_at = now + self.update_seconds
                context.health.note_update(free_at)
                for each in batch:
                    each.learned_from(free_at + 2 * each.trip_seconds)
            if tick % 5 == 0:
                reporter.row(learner, now)
            if tick % round(every / _TICK) == 0:
                yield now, reporter.status(0, now)


def scraped(status: RunStatus, name: str) -> list[float]:
    (family,) = [each for each in metrics([status]) if each.name == f"daedalus_{name}"]
    return [sample.value for sample in family.samples]


def silent(status: RunStatus) -> list[str]:
    """Return the actors that DaedalusActorSilent is about."""
    return [each.actor for each in status.actors if each.seconds_since_seen > each.silence_limit_seconds]


@pytest.mark.parametrize("algorithm", ["a3c", "a2c"])
def test_slow_simulators_are_healthy_and_their_rates_are_steady(algorithm: str) -> None:
    """Rollouts of 102 s: the windows of a minute and of a second that fast ones need see nothing but silence."""
    run = Run([Simulator(name, 0.1, 1024) for name in ("a", "b", "c")], algorithm)
    expected = (1 if algorithm == "a2c" else 3) / 102.4
    for now, status in run.looks(1200.0):
        assert (status.problems, silent(status)) == ((), []), now
        assert max(actor.seconds_since_seen for actor in status.actors) <= 6.0
        updates, env_steps = scraped(status, "updates_per_second"), scraped(status, "env_steps_per_second")
        if now < 102.0:
            assert (updates, env_steps) == ([], [])  # unknown, and not 0
            assert "is at row" in status.bottleneck
        else:
            assert updates == pytest.approx([expected], rel=0.5), now
            assert env_steps[0] > 0.0
            assert status.bottleneck.startswith("actors-bound: the learner waits 100% of the time"), now
        if now > 500.0:
            assert [actor.env_steps_per_second for actor in status.actors] == pytest.approx([100 / 102.4] * 3, rel=0.5)


def test_slow_simulators_of_an_older_release_are_known_by_their_rollouts() -> None:
    run = Run([Simulator(name, 0.1, 1024, reports=False) for name in ("a", "b", "c")])
    for now, status in run.looks(900.0):
        if now > 210.0:
            assert (status.problems, silent(status)) == ((), []), now


def test_a_simulator_that_hangs_is_silent_and_a_run_without_updates_is_stalled() -> None:
    one = Run([Simulator("a", 0.1, 1024, hangs_at=400.0), Simulator("b", 0.1, 1024)])
    *_, (_, status) = one.looks(700.0)
    assert (status.problems, silent(status)) == ((), ["a"])
    everyone = Run([Simulator(name, 0.1, 1024, hangs_at=400.0) for name in ("a", "b")])
    *_, (_, status) = everyone.looks(800.0)
    assert status.problems == ("no update for 492 s",)
    assert (scraped(status, "updates_per_second"), silent(status)) == ([0.0], ["a", "b"])


SLOW, FAST = 0.1, 0.02


@pytest.mark.parametrize(
    ("run", "begin"),
    [
        (
            lambda: Run([Simulator("a", FAST, 50), Simulator("b", FAST, 50)], update_seconds=1.0),
            "learner-bound: the learner computes updates ",
        ),
        (
            lambda: Run([Simulator("a", SLOW, 50), Simulator("far-1", SLOW, 50, trip_seconds=0.3)]),
            "actors-bound: the learner waits 100% of the time for rollouts; one takes 5.0 s",
        ),
        (
            lambda: Run([Simulator("a", 0.001, 50), Simulator("far-1", 0.001, 50, trip_seconds=0.3)], "a2c"),
            "network-bound: the learner waits 9",
        ),
        (
            lambda: Run(
                [Simulator("a", FAST, 50), Simulator("host-9", 10 * FAST, 50), Simulator("c", FAST, 50)], "a2c"
            ),
            "straggler: every update waits for host-9, which takes 10 s for a rollout; the others take 1.0 s",
        ),
    ],
    ids=["learner", "actors", "network", "straggler"],
)
def test_the_bottleneck_is_named(run: Callable[[], Run], begin: str) -> None:
    lines = [status.bottleneck for now, status in run().looks(120.0) if now > 60.0]
    assert all(line.startswith(begin) for line in lines), lines
