"""A sweep on this machine: its processes, its progress and its results."""

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TextIO

from daedalus.analysis.charts import COLUMNS, INSTALL, draw_curves
from daedalus.analysis.comparison import as_csv, as_text, compare_groups, final_returns
from daedalus.analysis.recorded_run import ENV_STEPS, SECONDS, read_run
from daedalus.analysis.run_groups import Group, select, short
from daedalus.analysis.statistics import interquartile_mean
from daedalus.analysis.sweep_plan import PlannedRun, has_begun, is_done
from daedalus.analysis.sweep_search import Search
from daedalus.launch.process_lifecycle import FINISHED
from daedalus.launch.supervision import stop
from daedalus.learner.reporting.progress import RewrittenLine
from daedalus.learner.run.run_directory import METRICS, SUMMARY, read_json, remove_failed
from daedalus.learner.run.run_files import RunDataError
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.regular_files import replacing
from daedalus.protocol.texts import one_line, short_number

_DAEDALUS = [sys.executable, "-P", "-m", "daedalus"]
_GRACE_SECONDS = 4.4  # from SIGTERM to SIGKILL; a run needs up to 4 s to end its own processes
_GROUP_SECONDS = 0.4  # for killed processes to disappear; both together stay below 5 s
_GROUP_POLL_SECONDS = 0.01
_LOG_TAIL_BYTES = 1 << 14
_LONGEST_REASON = 300  # characters

Start = Callable[[PlannedRun, IO[bytes]], "subprocess.Popen[bytes]"]


def start_training(run: PlannedRun, log: IO[bytes]) -> "subprocess.Popen[bytes]":
    """Start or resume a run. The process ends when this one ends, and is not in the terminal's group for Ctrl-C."""
    if not has_begun(run):
        remove_failed(run.directory)  # what is left of a run that was killed at its start
    words = run.resume_words if has_begun(run) else run.words
    return subprocess.Popen(
        [*_DAEDALUS, *words, "--exit-with-parent"],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


@dataclass(slots=True, eq=False)
class _Running:
    run: PlannedRun
    process: "subprocess.Popen[bytes]"
    log: IO[bytes]


class RunProcesses:
    """Processes of runs, at most `jobs` at a time."""

    def __init__(self, jobs: int, start: Start = start_training) -> None:
        self._jobs, self._start = jobs, start
        self._running: list[_Running] = []

    @property
    def full(self) -> bool:
        """Whether no further run may start."""
        return len(self._running) >= self._jobs

    @property
    def runs(self) -> Sequence[PlannedRun]:
        """The runs whose processes were started and have not been collected."""
        return [running.run for running in self._running]

    def begin(self, run: PlannedRun) -> None:
        """Start or continue a run. Raises OSError."""
        run.log.parent.mkdir(parents=True, exist_ok=True)
        log = open(run.log, "ab")  # noqa: SIM115 - closed when the process has ended
        try:
            self._running.append(_Running(run, self._start(run, log), log))
        except BaseException:
            log.close()
            raise

    def collect(self) -> list[tuple[PlannedRun, int]]:
        """Return the runs whose processes have ended since the last call, with their exit statuses."""
        ended = [running for running in self._running if running.process.poll() is not None]
        for running in ended:
            self._running.remove(running)
            running.log.close()
            if running.process.stdin is not None:
                running.process.stdin.close()
        return [(running.run, running.process.returncode) for running in ended]

    def stop(self) -> None:
        """End all processes and their children: those that obey SIGTERM, and the others after a few seconds."""
        processes = [running.process for running in self._running]
        stop(processes, grace_seconds=_GRACE_SECONDS)
        _end_groups([process.pid for process in processes])
        self.collect()


def _end_groups(groups: Sequence[int]) -> None:
    """Kill what is left of process groups whose leaders have ended, and wait a moment until nothing is left.

    The learner of a run that had to be killed would hold the lock of the run for a few seconds more.
    """
    deadline = time.monotonic() + _GROUP_SECONDS
    left = set(groups) if hasattr(os, "killpg") else set()  # Windows has no process groups
    while left and time.monotonic() < deadline:
        for group in sorted(left):
            try:
                os.killpg(group, signal.SIGKILL)
            except (ProcessLookupError, PermissionError):  # macOS refuses it where only zombies are left
                left.remove(group)
        if left:
            time.sleep(_GROUP_POLL_SECONDS)


def reason(log: Path, status: int) -> str:
    """Return why a run failed, in one line, from what it printed last."""
    try:
        with open(log, "rb") as file:
            file.seek(max(file.seek(0, 2) - _LOG_TAIL_BYTES, 0))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        lines = []
    lines = [line.strip() for line in lines if line.strip()]
    own = [line for line in lines if re.match(r"daedalus (train|resume): ", line)]
    found = [re.sub(r"^daedalus (train|resume): ", "", line) for line in own] or lines or [f"exit status {status}"]
    return found[-1][:_LONGEST_REASON]


_TERMINAL_SECONDS = 1.0  # between lines on a terminal
_LINE_SECONDS = 60.0  # and elsewhere
_TAIL_BYTES = 1 << 13


class Display(RewrittenLine):
    """Lines about a sweep."""

    def __init__(self, stream: TextIO, total: int) -> None:
        """`total` is the number of runs."""
        super().__init__(stream)
        self._total = total
        self._terminal = stream.isatty()
        self._began = time.monotonic()
        self._next = self._began + (0.0 if self._terminal else _LINE_SECONDS)
        self._first_share: float | None = None

    @property
    def terminal(self) -> bool:
        """Whether a person watches."""
        return self._terminal

    def say(self, text: str) -> None:
        """Print a permanent line."""
        self._write(f"\r\x1b[K{text}\n" if self._rewriting else f"{text}\n")
        self._rewriting = False

    def show(self, ended: int, failed: int, running: Sequence[PlannedRun]) -> None:
        """Show the progress, if it is time for it."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (_TERMINAL_SECONDS if self._terminal else _LINE_SECONDS)
        rows = [newest_row(run) for run in running]
        shares = [
            row.get("env_steps", 0.0) / run.spec.training.env_steps for row, run in zip(rows, running, strict=True)
        ]
        parts = [f"{ended} of {self._total} runs", *([f"{failed} failed"] if failed else [])]
        parts.append(self._left((ended + sum(shares)) / max(self._total, 1), now))
        for run, row, share in zip(running, rows, shares, strict=True):
            mean = row.get("episode_return_mean")
            parts.append(f"{run.name} {100 * share:.0f} %" + ("" if mean is None else f" return {short_number(mean)}"))
        if self._terminal:
            self.rewrite("  ".join(parts)[: max(shutil.get_terminal_size().columns - 1, 0)])
        else:
            self._write("  ".join(parts) + "\n")

    def _left(self, share: float, now: float) -> str:
        """Return the time left, from the share of the runs that is done: at most, as runs may reach their target."""
        if self._first_share is None:
            self._first_share = share
            self._began = now
        done = share - self._first_share
        if done <= 0.0:
            return "left -"
        seconds = (now - self._began) * (1.0 - share) / done
        return f"left {seconds:.0f} s" if seconds < 100.0 else f"left {seconds / 60:.0f} min"


def newest_row(run: PlannedRun) -> dict[str, float]:
    """Return the known values of the newest row of a run's metrics; empty without one.

    Reads the end of the file only, because this is called every second.
    """
    try:
        with open(run.directory / METRICS, "rb") as file:
            header = file.readline()
            start = max(file.seek(0, 2) - _TAIL_BYTES, len(header))
            file.seek(start)
            lines = file.read().split(b"\n")[:-1]  # without the line that is being written
        names, cells = (next(csv.reader([line.decode()])) for line in (header, lines[-1]))
        return {name: float(cell) for name, cell in zip(names, cells, strict=True) if cell}
    except (OSError, ValueError, IndexError, csv.Error, StopIteration):
        return {}


_POLL_SECONDS = 0.1


@dataclass(slots=True)
class SweepEnd:
    """End of a sweep."""

    done: list[PlannedRun] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)  # reason by the name of the run
    stopped: bool = False


class Sweep:
    """Runs of a search, until all have ended or the sweep is stopped."""

    def __init__(self, search: Search, processes: RunProcesses, display: Display) -> None:
        self._search, self._processes, self._display = search, processes, display
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
            if is_done(run):
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
        elif not is_done(run):
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


TABLE, RUNS, CURVES = "table.csv", "runs.csv", "curves.png"


def report(folder: Path, planned: Sequence[PlannedRun], end: SweepEnd, keys: Sequence[str], *, ranked: bool) -> str:
    """Write table.csv, runs.csv and curves.png, and return the text for the terminal.

    Args:
      folder: folder of the sweep.
      planned: all runs, with those that failed.
      end: which of them ended how.
      keys: settings that the sweep varies.
      ranked: sort the settings by their final return, best first, and not by their values.

    Raises OSError, RunDataError if no run can be used.
    """
    _write_runs(folder / RUNS, planned, end, keys)
    directories = [run.directory for run in planned if run in end.done]
    if not directories:
        return _failures(end)
    (groups,), problems = select([directories], finished=True, columns=[SECONDS, *COLUMNS], keys=keys)
    if ranked:
        groups.sort(key=_final_return, reverse=True)
    comparisons = [compare_groups(groups)]
    with replacing(folder / TABLE) as beside:
        beside.write_bytes(as_csv(comparisons).encode())  # with the ends of lines that it has
    lines = ["", as_text(comparisons), *problems]
    try:
        draw_curves(groups, folder / CURVES, ENV_STEPS)
        written = f"{folder}: {TABLE}, {RUNS}, {CURVES} and the run directories"
    except ModuleNotFoundError:
        written = f"{folder}: {TABLE}, {RUNS} and the run directories; no picture: {INSTALL}"
    return "\n".join([*lines, written, *([_failures(end)] if end.failed else [])])


def _final_return(group: Group) -> float:
    return float(interquartile_mean(final_returns(group, evaluated=True)))


def _failures(end: SweepEnd) -> str:
    names = ", ".join(end.failed)
    return f"failed: {len(end.failed)} ({names}); the same command tries them again"


def _write_runs(path: Path, planned: Sequence[PlannedRun], end: SweepEnd, keys: Sequence[str]) -> None:
    """Write one line for each run."""
    with replacing(path) as beside, open(beside, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        results = ("state", "final_return", "env_steps", "minutes", "reached_target")
        writer.writerow(["run", *(short(key, keys) for key in keys), "seed", *results])
        for run in planned:
            values = [run.point[key] for key in keys]
            writer.writerow([run.name, *values, run.seed, *_result(run, end)])


def _result(run: PlannedRun, end: SweepEnd) -> list[object]:
    if run.name in end.failed:
        return [one_line(f"failed: {end.failed[run.name]}"), "", "", "", ""]
    try:
        recorded = read_run(run.directory, [SECONDS])
    except RunDataError as error:
        return [str(error), "", "", "", ""]
    summary = recorded.summary
    minutes = summary.get("wall_seconds", 0.0) / 60.0
    return ["done", recorded.evaluation_return, summary.get("env_steps"), minutes, summary.get("solved")]
