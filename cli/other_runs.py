"""Earlier runs for the page of a gateway: their metrics, read from the run directories again when they change."""

import logging
from pathlib import Path

from daedalus.gateway.watching.page_data import OtherRun
from daedalus.learner.reporting.metrics_file import read_rows
from daedalus.learner.run.run_directory import METRICS
from daedalus.learner.serving.metrics_history import MetricsHistory

_logger = logging.getLogger(__name__)

MAX_RUNS = 8


class OtherRuns:
    """Readers of run directories that the user named on the command line. One thread at a time."""

    def __init__(self, directories: list[Path]) -> None:
        """Raise ValueError or OSError if a directory is none of a run, or if there are too many."""
        if len(directories) > MAX_RUNS:
            raise ValueError(f"{len(directories)} runs are given with --compare: at most {MAX_RUNS} can be shown")
        self._known: dict[Path, tuple[int, OtherRun]] = {}  # with the time of the file
        self._directories = directories
        for directory in directories:
            self._read(directory)

    def __call__(self) -> list[OtherRun]:
        """Return the runs. One whose file cannot be read is as it was."""
        for directory in self._directories:
            try:
                self._read(directory)
            except (OSError, ValueError) as error:
                _logger.warning("the run to compare with cannot be read: %s", error)
        return [self._known[directory][1] for directory in self._directories]

    def _read(self, directory: Path) -> None:
        path = directory / METRICS
        if not path.exists():
            raise ValueError(f"{directory} has no {METRICS}: it is no run directory, or its run has not begun to train")
        changed = path.stat().st_mtime_ns
        if directory in self._known and self._known[directory][0] == changed:
            return
        history = MetricsHistory()
        for row in read_rows(path):
            history.add(row)
        self._known[directory] = changed, OtherRun(name=directory.resolve().name, rows=history.rows())
