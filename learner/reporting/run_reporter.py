"""Metrics rows, status and summary of one run, made from what its parts have counted."""

import threading
from typing import TYPE_CHECKING, Any

from daedalus.learner.reporting.metrics import Details
from daedalus.learner.reporting.report import Health, RateMeter, metrics_row, run_status, summary
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.evaluations import Evaluations
from daedalus.learner.serving.fleet import Fleet
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.status import RunStatus

if TYPE_CHECKING:
    from daedalus.learner.training.learner import Learner


class RunReporter:
    """Reads counters, fleet and health under their lock. No I/O."""

    def __init__(
        self,
        run: str,
        spec: RunSpec,
        learner_epoch: int,
        *,
        counters: RunCounters,
        fleet: Fleet,
        lock: threading.Condition,
        evaluations: Evaluations,
        health: Health,
        started: float,
    ) -> None:
        """`started`, on the monotonic clock, is what the run's seconds count from; `lock` guards counters and fleet."""
        self._run, self._spec, self._epoch = run, spec, learner_epoch
        self._counters, self._fleet, self._lock = counters, fleet, lock
        self._evaluations, self._health, self._started = evaluations, health, started
        self._meter = RateMeter(counters, started)

    def begin(self, now: float) -> None:
        """Start to measure rates: learning begins."""
        self._meter = RateMeter(self._counters, now)
        self._health.updated = self._health.attended = now

    def wall_seconds(self, now: float) -> float:
        """Return the seconds that the run has taken, resumed parts included."""
        return self._counters.wall_seconds + now - self._started

    def counters_state(self, now: float) -> dict[str, Any]:
        """Return the counters as a checkpoint holds them."""
        with self._lock:
            return self._counters.state(self.wall_seconds(now))

    def row(self, learner: "Learner", now: float) -> dict[str, float]:
        """Return a metrics row: rates and means since the row before."""
        with self._lock:
            progress = self._counters.env_steps / self._spec.training.env_steps
            rates = self._meter.look(self._counters, self._fleet, now)
            if self._fleet.live:
                self._health.attended = now
            learning = {
                **learner.metrics.take_means(),
                **self._evaluations.take_newest(),
                "learning_rate": learner.learning_rate(progress),
                "entropy_bonus": learner.entropy_bonus(progress),
            }
            return metrics_row(self._counters, self._fleet, rates, learning, self.wall_seconds(now))

    def details(self, learner: "Learner") -> Details:
        """Return what belongs to a row and is no single number."""
        with self._lock:
            returns, lengths = list(self._counters.returns), list(self._counters.lengths)
        return Details(
            returns=returns,
            lengths=lengths,
            action_counts=learner.metrics.take_action_counts(),
            picture=learner.metrics.take_observation_image(),
        )

    def status(self, queue_bytes: int, now: float) -> RunStatus:
        """Return the answer to a status query. Called with the lock held."""
        return run_status(
            self._run,
            self._epoch,
            self._spec,
            self._counters,
            self._fleet,
            self._meter.rates,
            self._health,
            queue_bytes,
            now,
        )

    def summary(self, *, solved: bool, finished: bool, seconds_to_target: float | None, now: float) -> dict[str, Any]:
        """Return what summary.json holds at the end; the rate is over this process's learning."""
        return summary(
            self._run,
            self._spec,
            self._counters,
            solved=solved,
            finished=finished,
            seconds_to_target=seconds_to_target,
            wall_seconds=self.wall_seconds(now),
            env_steps_per_second=self._meter.overall(self._counters, now),
        )
