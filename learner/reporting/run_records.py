"""Records of a run: rows of metrics, events and the summary. A disk error is logged and does not end the run."""

import logging
from typing import TYPE_CHECKING, Any

from daedalus.learner.reporting.metrics_file import read_rows
from daedalus.learner.reporting.recorder import Recorder
from daedalus.learner.reporting.run_reporter import RunReporter
from daedalus.learner.run.run_directory import METRICS, SUMMARY, write_json
from daedalus.learner.run.run_state import RunState
from daedalus.learner.serving.metrics_history import MetricsHistory

if TYPE_CHECKING:
    from daedalus.learner.training.learner import Learner

_logger = logging.getLogger(__name__)


class RunRecords:
    """Writer of the records of one run during training, from construction to `close`."""

    def __init__(self, state: RunState, reporter: RunReporter, history: MetricsHistory, recorder: Recorder) -> None:
        """Construct the writer.

        Args:
          state: names the directory.
          reporter: source of the rows and of the summary.
          history: receives each row, for operators who watch the run.
          recorder: writes the rows; it is closed with the records.
        """
        self._directory, self._reporter = state.directory, reporter
        self._history, self._recorder = history, recorder
        state.health.recording_since = lambda: recorder.busy_since

    def record(self, learner: "Learner", now: float, *, last: bool = False) -> None:
        """Record a row of metrics, and log a hint if one is due. `last` marks the row of a stop."""
        row = self._reporter.row(learner, now, last=last)
        self._history.add(row)
        self._recorder.record(row, self._reporter.details(learner, now, last=last))
        if not last and (hint := self._reporter.hint()):
            _logger.warning("%s", hint)

    def close(self) -> None:
        """Write the queued rows."""
        self._recorder.close()

    def write_summary(self, *, finished: bool, ended: float, confirmation: dict[str, Any] | None) -> None:
        """Write summary.json.

        Args:
          finished: whether the run is over, rather than stopped.
          ended: when training ended, on the monotonic clock, in seconds.
          confirmation: result of the new episodes that confirmed the target; None without them.
        """
        content = self._reporter.summary(finished=finished, now=ended)
        if confirmation is not None:
            content["confirmation"] = confirmation
            content["confirmation_return_mean"] = confirmation["return_mean"]
        try:
            write_json(self._directory / SUMMARY, content)
        except OSError as error:
            _logger.warning("summary not written: %s", error.strerror)


def load_history(state: RunState, history: MetricsHistory) -> None:
    """Add the rows of the learner processes before, as far as the checkpoint that the run continues from."""
    try:
        for row in read_rows(state.directory / METRICS):
            if row["env_steps"] <= state.counters.env_steps:
                history.add(row)
    except (OSError, ValueError) as error:
        _logger.warning("the metrics before the checkpoint cannot be read: %s", error)
