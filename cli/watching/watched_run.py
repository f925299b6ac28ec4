"""A run as its learner reports it, query after query. State; no I/O."""

import math

from daedalus.learner.reporting.progress import StepRate
from daedalus.protocol.messages import MetricsReport, RunStatus

_RETURN = "episode_return_mean"
_MAX_RETURNS = 4096  # then every second one is dropped


class WatchedRun:
    """Newest status of a learner, and the returns of its whole run."""

    def __init__(self, status: RunStatus) -> None:
        self.status = status
        self.returns: list[float] = []  # mean of the newest episodes, from the begin of the run on
        self.rate = 0.0  # env_steps per second, over the last seconds
        self.next_row = 0  # of the metrics, not seen yet
        self._meter = StepRate()

    @property
    def seconds_left(self) -> float | None:
        """Seconds until the budget is used up, or None if it is not known. A run may reach its target before."""
        left = self.status.env_steps_budget - self.status.env_steps
        return max(left, 0) / self.rate if self.rate > 0.0 else None

    def add_status(self, status: RunStatus) -> None:
        """Take a newer status of the same learner."""
        self.status = status
        self.rate = self._meter.add(status.uptime_seconds, status.env_steps) or status.env_steps_per_second

    def add_rows(self, report: MetricsReport) -> None:
        """Take further rows of the metrics."""
        if not len(report.numbers):
            return
        self.next_row = int(report.numbers[-1]) + 1
        if _RETURN in report.page.columns:
            values = report.values[:, report.page.columns.index(_RETURN)].tolist()
            self.returns += [value for value in values if math.isfinite(value)]
        while len(self.returns) > _MAX_RETURNS:
            del self.returns[::2]
