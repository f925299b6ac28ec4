"""Metrics rows, status and summary of one run, from its counters, fleet and health."""

import math
import threading
from typing import TYPE_CHECKING, Any

from daedalus.learner.reporting.episode_hint import EpisodeHint
from daedalus.learner.reporting.learning_hint import LearningHint
from daedalus.learner.reporting.metrics import Details
from daedalus.learner.reporting.rates import RateMeter
from daedalus.learner.reporting.report import metrics_row, run_status, summary
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run.run_state import RunState
from daedalus.learner.serving.fleet import Fleet
from daedalus.protocol.messages import RunStatus

if TYPE_CHECKING:
    from daedalus.learner.training.learner import Learner


_DETAILS_SECONDS = 10.0  # between details: they take far more space than a row


class RunReporter:
    """Reporter of one run. Reads the counters and the fleet under their lock. No I/O."""

    def __init__(self, state: RunState, fleet: Fleet, lock: threading.Condition, user_metrics: UserMetrics) -> None:
        """Construct the reporter. `lock` guards the counters and the fleet."""
        self._state, self._counters, self._fleet, self._lock = state, state.counters, fleet, lock
        self._user_metrics = user_metrics
        self._details_at = -math.inf  # when the next details are due
        training = state.spec.training
        self._meter = RateMeter(self._counters, state.health.started)
        self._episode_hint = EpisodeHint(training.env_steps)
        self._learning_hint = LearningHint(training.env_steps, normalizes_rewards=training.normalize_rewards)

    def begin(self, now: float) -> None:
        """Start to measure rates, at the begin of training."""
        self._meter = RateMeter(self._counters, now)
        self._state.health.updated = self._state.health.actor_seen = now

    def row(self, learner: "Learner", now: float, *, last: bool = False) -> dict[str, float]:
        """Return a metrics row, with rates and means since the previous row. `last` marks that of a stop."""
        learned = {**learner.metrics.take_means(), **learner.take_diagnostics()}
        with self._lock:
            progress = self._state.progress
            rates = self._meter.measure(self._counters, self._fleet, now, last=last)
            if self._fleet.live:
                self._state.health.actor_seen = now
            learning = {
                **learned,
                **self._state.evaluations.take_newest(),
                "learning_rate": learner.learning_rate(progress),
                "entropy_bonus": learner.entropy_bonus(progress),
                **self._user_metrics.take(),
            }
            row = metrics_row(self._counters, self._fleet, rates, learning, self._state.wall_seconds(now))
        self._learning_hint.add(row)
        return row

    def hint(self) -> str:
        """Return a hint for the user if one is due, else an empty string."""
        with self._lock:
            hint = self._episode_hint.take(self._counters, self._fleet)
        return hint or self._learning_hint.take()

    def details(self, learner: "Learner", now: float, *, last: bool = False) -> Details:
        """Return the distributions and the picture that belong to a metrics row; most rows have none."""
        if now < self._details_at and not last:
            return Details()
        self._details_at = now + _DETAILS_SECONDS
        with self._lock:
            returns, lengths = list(self._counters.returns), list(self._counters.lengths)
        return Details(
            returns=returns,
            lengths=lengths,
            action_counts=learner.metrics.take_action_counts(),
            picture=learner.metrics.take_observation_image(),
        )

    def status(self, queue_bytes: int, now: float) -> RunStatus:
        """Return the answer to a status query. The caller holds the lock."""
        return run_status(
            self._state.name,
            self._state.learner_epoch,
            self._state.spec,
            self._counters,
            self._fleet,
            self._meter.rates,
            self._state.health,
            queue_bytes,
            now,
        )

    def summary(self, *, finished: bool, now: float) -> dict[str, Any]:
        """Return the content of summary.json. Its env_steps_per_second is over the training of this process."""
        return summary(
            self._state.name,
            self._state.spec,
            self._counters,
            finished=finished,
            wall_seconds=self._state.wall_seconds(now),
            env_steps_per_second=self._meter.overall(self._counters, now),
        )
