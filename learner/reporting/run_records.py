"""Records of a run: rows of metrics, events and the summary. A disk error is logged and does not end the run."""

import logging
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daedalus.learner.reporting.csv_writer import cut_rows
from daedalus.learner.reporting.metrics_file import read_rows
from daedalus.learner.reporting.recorder import Recorder
from daedalus.learner.reporting.run_reporter import RunReporter
from daedalus.learner.reporting.tensorboard_writer import TensorBoardWriter
from daedalus.learner.run.run_directory import EVALUATION, METRICS, SUMMARY, read_json, write_json
from daedalus.learner.run.run_state import RunState
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.events import RESUMED, EventLog
from daedalus.learner.serving.metrics_history import MetricsHistory
from daedalus.policy.saving.best_checkpoints import set_aside_newer

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


def continue_records(state: RunState, policy_version: int, history: MetricsHistory, events: EventLog) -> None:
    """Undo what the learner processes before recorded after the checkpoint of this policy version; read the rest.

    Rows of the metrics and best checkpoints of env_steps that the run makes again would be those of other weights.
    Scores of episodes with another environment.max_episode_steps are no longer comparable.
    """
    directory, env_steps = state.directory, state.counters.env_steps
    try:
        rows = cut_rows(directory / METRICS, env_steps)
        if rows:
            writer = TensorBoardWriter(directory)
            writer.purge(env_steps)
            writer.close()
            state.evaluations.carry_over(rows)
        undone = [f"{len(rows):,} rows of {METRICS}"] if rows else []
        comparable = -1 if state.other_episodes else policy_version  # the highest version whose score is
        undone += [f"{each.name}, whose policy is kept" for each in set_aside_newer(directory, comparable)]
        undone += _remove_later_results(directory, env_steps, policy_version)
        if undone:
            text = f"continues at {env_steps:,} env_steps: undone are {', '.join(undone)}"
            events.add("checkpoint", f"{RESUMED}{text}")
        for row in read_rows(directory / METRICS):
            history.add(row)
    except FileNotFoundError:
        return  # no row yet
    except (OSError, ValueError) as error:
        _logger.warning("the metrics before the checkpoint cannot be read: %s", error)


def _remove_later_results(directory: Path, env_steps: int, policy_version: int) -> list[str]:
    """Remove the results of a run that had come further than the checkpoint, and return their names."""
    removed = []
    for name, key, reached in ((SUMMARY, "env_steps", env_steps), (EVALUATION, "policy_version", policy_version)):
        with suppress(SettingsError):  # missing, or damaged: others say so
            later = read_json(directory / name).get(key)
            if isinstance(later, int) and later > reached:
                (directory / name).unlink()
                removed.append(name)
    return removed
