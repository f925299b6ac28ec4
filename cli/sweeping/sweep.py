"""The sweep itself: starts the runs of a search, a few at a time, and takes note of their ends."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from daedalus.cli.sweeping.display import Display
from daedalus.cli.sweeping.plan import PlannedRun, has_begun, is_done
from daedalus.cli.sweeping.processes import FINISHED, RunProcesses, reason
from daedalus.cli.sweeping.searches import Search
from daedalus.learner.run.run_directory import SUMMARY, read_json
from daedalus.learner.run.settings import SettingsError
from daedalus.protocol.texts import short_number

_POLL_SECONDS = 0.1


@dataclass(slots=True)
class SweepEnd:
    """End of a sweep."""

    done: list[PlannedRun] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)  # reason by the name of the run
    stopped: bool = False


class Sweep:
    """Runs of a search, until all have ended or the sweep is stopped."""

    def __init__(
        self, search: Search, processes: RunProcesses, display: Display, done: Callable[[PlannedRun], bool] = is_done
    ) -> None:
        """`done` tells whether a run needs no process any more."""
        self._search, self._processes, self._display, self._is_done = search, processes, display, done
        self._end = SweepEnd()
        self._kept = 0  # runs that had ended before this sweep

    def run(self, stopping: threading.Event) -> SweepEnd:
        """Run until all runs have ended, or until `stopping` is set. No process is left when this returns or raises.

        Raises SettingsError, OSError.
        """
        try:
            while not stopping.is_set():
                for run, status in self._processes.collect():
                    self._ended(run, status)
                self._fill(stopping)
                if not self._processes.runs:
                    break
                self._display.show(len(self._end.done), len(self._end.failed), self._processes.runs)
                stopping.wait(_POLL_SECONDS)
        finally:
            self._processes.stop()
            self._display.end()
        self._end.stopped = stopping.is_set()
        return self._end

    def _fill(self, stopping: threading.Event) -> None:
        """Start runs as long as there is room."""
        while not self._processes.full and not stopping.is_set():
            run = self._search.take()
            if run is None:
                break
            if self._is_done(run):
                self._kept += 1
                self._end.done.append(run)
                self._search.ended(run, failed=False)
                continue
            self._tell_kept()
            if not self._display.terminal:
                self._display.say(f"{run.name}: {'continues' if has_begun(run) else 'begins'}")
            self._processes.begin(run)
        self._tell_kept()

    def _tell_kept(self) -> None:
        if self._kept:
            self._display.say(f"{self._kept} of {self._search.total} runs had ended before")
        self._kept = 0

    def _ended(self, run: PlannedRun, status: int) -> None:
        failure = ""
        if status not in FINISHED:
            failure = reason(run.log, status)
        elif not self._is_done(run):
            failure = f"it ended without a result; see {run.log}"
        if failure:
            self._end.failed[run.name] = failure
            self._display.say(f"{run.name}: failed: {failure}")
        else:
            self._end.done.append(run)
            self._display.say(f"{run.name}: {result(run)}")
        self._search.ended(run, failed=bool(failure))


def result(run: PlannedRun) -> str:
    """Return the result of a run in one line."""
    try:
        summary = read_json(run.directory / SUMMARY)
    except SettingsError as error:
        return str(error)
    end = "target reached" if summary["solved"] else "done"
    return (
        f"{end} after {summary['env_steps']:,} env_steps, {summary['wall_seconds']:.0f} s; "
        f"final return {short_number(summary['evaluation_return_mean'])}"
    )
