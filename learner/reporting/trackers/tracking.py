"""Logging of a run to one tracker, in a process of its own that only reads the run directory.

metrics.csv is the queue between the learner and the tracker: the learner never waits, and a row is not lost while the
tracker does not answer.
"""

import csv
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Self

from daedalus.learner.reporting.metrics_rows import GROUPS, Details, numbers
from daedalus.learner.reporting.trackers.tracker import TRACKERS, OpenTracker, TrackedRun, Tracker, flat
from daedalus.learner.run.run_directory import CONFIG, METRICS, SUMMARY, TRACKER, read_json, write_json
from daedalus.learner.run.settings import SettingsError, read_settings

_UNKNOWN = 1e300  # seconds, later than any row


@dataclass(slots=True, kw_only=True)
class TrackingState:
    """State of one tracker between two processes."""

    id: str = ""  # the tracker's id of the run; empty before the first start
    # Of the newest row that was logged. An earlier release did not keep the last two.
    env_steps: int = -1
    wall_seconds: float = 0.0
    evaluation_env_steps: int = -1  # of the newest evaluation that was logged

    @classmethod
    def load(cls, directory: Path, name: str) -> Self:
        """Read the state of a tracker; a missing or damaged file is a new state."""
        try:
            content = read_json(_path(directory, name))
            env_steps = int(content["env_steps"])
            return cls(
                id=str(content["id"]),
                env_steps=env_steps,
                wall_seconds=float(content.get("wall_seconds", _UNKNOWN)),
                evaluation_env_steps=int(content.get("evaluation_env_steps", env_steps)),
            )
        except (SettingsError, KeyError, TypeError, ValueError):
            return cls()

    def save(self, directory: Path, name: str) -> None:
        """Write the state. Raises OSError."""
        write_json(_path(directory, name), asdict(self))


def chosen_trackers(chosen: Sequence[str], directory: Path) -> Sequence[str]:
    """Return the trackers of a run: those that the user has chosen, and those that have logged it before.

    A metrics writer of the user's is not continued by itself: a file must not say which module is imported.
    """
    return list(dict.fromkeys([*chosen, *(name for name in TRACKERS if _path(directory, name).exists())]))


def _path(directory: Path, name: str) -> Path:
    return directory / TRACKER.format(name.replace(":", "."))


class MetricsFollower:
    """Reader of the complete rows of a metrics.csv that grows. It keeps no file open between two calls.

    The file is written anew with new columns, with old rows merged, and, by a resumed run, without the rows after its
    checkpoint. Its rows are then read again from the first one on.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._header = b""
        self._at = 0  # bytes, after the rows whose use has ended without an exception
        self._last = b""  # line before there

    @property
    def exist(self) -> bool:
        """Whether the learner has written to the file."""
        return self._path.exists()

    def rows(self) -> Iterator[dict[str, float]]:
        """Yield the rows since the last call, or all of a file that was written anew. A damaged row is empty.

        Raises OSError.
        """
        if not self.exist:
            return
        with open(self._path, "rb") as file:
            header = file.readline()
            if not header.endswith(b"\n"):
                return
            if header != self._header or not self._is_at_last(file):
                self._header = self._last = header
                self._at = len(header)
            columns = _cells(header)
            file.seek(self._at)
            while (line := file.readline()).endswith(b"\n"):
                row = numbers(columns, _cells(line))
                yield row if "env_steps" in row else {}
                self._at += len(line)
                self._last = line

    def _is_at_last(self, file: BinaryIO) -> bool:
        """Return whether the line before the position is still the one that was taken last."""
        file.seek(self._at - len(self._last))
        return file.read(len(self._last)) == self._last


def _cells(line: bytes) -> list[str]:
    try:
        return next(csv.reader([line.decode("utf-8", "replace")]), [])
    except csv.Error:
        return []


_POLL_SECONDS = 1.0
_RETRY_SECONDS = 60.0  # after the tracker failed
_SLOW_SECONDS = 60.0  # for one call, before the user is warned
_SECONDS_A_SAVE = 10.0  # of the state, while many rows are new
_LONGEST_FAULT = 300  # characters

_logger = logging.getLogger(__name__)


class Tracking:
    """Logger of the rows of a run, in order and at most once, and of its summary at the end.

    A resumed run makes some env_steps again, from its checkpoint on. Trackers require increasing steps, so these rows
    are left out; an evaluation in them is logged with the next row.
    """

    def __init__(self, name: str, directory: Path, open_tracker: OpenTracker, finish: threading.Event) -> None:
        """Construct the logger.

        Args:
          name: of the tracker.
          directory: the run directory.
          open_tracker: called with the run; again after the tracker failed.
          finish: set when the run has ended and its files are complete.
        """
        self._name, self._directory, self._open, self._finish = name, directory, open_tracker, finish
        self._state = TrackingState.load(directory, name)
        self._rows = MetricsFollower(directory / METRICS)
        self._tracker: Tracker | None = None
        self._evaluation: dict[str, float] = {}  # of rows that were left out
        self._warned = False
        self._call_began: float | None = None

    def run(self) -> bool:
        """Log until the run has ended. Return whether everything was logged."""
        threading.Thread(target=self._watch, name="slow-tracker", daemon=True).start()
        retry_at = time.monotonic()
        while True:
            last = self._finish.wait(_POLL_SECONDS)
            if not last and time.monotonic() < retry_at:
                continue
            try:
                with self._timed():
                    self._log(last=last)
            except Exception as error:  # of a package that is not ours
                fault = f"{type(error).__name__}: {' '.join(str(error).split())[:_LONGEST_FAULT]}"
                self._warn(f"{fault}; it is tried again every {_RETRY_SECONDS:.0f} s")
                self._drop_tracker()
                retry_at = time.monotonic() + _RETRY_SECONDS
                if last:
                    return False
            if last:
                return True

    def _log(self, *, last: bool) -> None:
        """Log what is new in the run directory."""
        if not (self._rows.exist or (last and self._state.id)):
            # A run that fails at its start is not logged. Before the first row, the import of the tracker's package
            # would compete with the start of the run.
            return
        if self._tracker is None:
            self._tracker = self._opened()
        before, save_at = replace(self._state), time.monotonic() + _SECONDS_A_SAVE
        try:
            for row in self._rows.rows():
                self._log_row(self._tracker, row)
                if time.monotonic() >= save_at:
                    save_at = time.monotonic() + _SECONDS_A_SAVE
                    self._save()
        finally:
            if self._state != before:
                self._save()
        if last:
            self._tracker.summarize(_summary(self._directory))
            self._tracker.close()

    def _log_row(self, tracker: Tracker, row: dict[str, float]) -> None:
        """Log a row, unless the tracker has received it or later ones."""
        state = self._state
        if (row.get("env_steps", -1), row.get("wall_seconds", 0.0)) > (state.env_steps, state.wall_seconds):
            row = {**self._evaluation, **row}
            tracker.write(row, Details())
            state.env_steps, state.wall_seconds = int(row["env_steps"]), row.get("wall_seconds", 0.0)
            state.evaluation_env_steps = int(row.get("evaluation_env_steps", state.evaluation_env_steps))
            self._evaluation = {}
            self._call_began = time.monotonic()  # each row has its time
        elif row.get("evaluation_env_steps", -1) > state.evaluation_env_steps:
            self._evaluation |= {name: row[name] for name in GROUPS["evaluation"] if name in row}

    def _opened(self) -> Tracker:
        settings = read_settings(self._directory / CONFIG)
        tracker = self._open(TrackedRun(directory=self._directory.resolve(), settings=settings, id=self._state.id))
        self._state.id = tracker.id
        self._save()
        _logger.info("%s: %s", self._name, tracker.place)
        return tracker

    def _save(self) -> None:
        with suppress(OSError):  # the learner reports a full disk
            self._state.save(self._directory, self._name)

    def _drop_tracker(self) -> None:
        if self._tracker is not None:
            with suppress(Exception):
                self._tracker.close()
            self._tracker = None
            self._rows = MetricsFollower(self._directory / METRICS)

    @contextmanager
    def _timed(self) -> Iterator[None]:
        self._call_began = time.monotonic()
        try:
            yield
        finally:
            self._call_began = None

    def _watch(self) -> None:
        """Warn if a call takes long. The call itself cannot be ended; the end of the process ends it."""
        while not self._warned:
            time.sleep(_POLL_SECONDS)
            began = self._call_began
            if began is not None and time.monotonic() - began > _SLOW_SECONDS:
                self._warn(f"no answer for {_SLOW_SECONDS:.0f} s")

    def _warn(self, fault: str) -> None:
        """Warn once."""
        if not self._warned:
            self._warned = True
            _logger.warning("%s: %s; training continues, and its metrics are in metrics.csv", self._name, fault)


def _summary(directory: Path) -> dict[str, Any]:
    """Return the numbers and texts of summary.json; empty if the run has none."""
    try:
        summary = read_json(directory / SUMMARY)
    except SettingsError:
        return {}
    return {name: value for name, value in flat(summary) if isinstance(value, int | float | str)}
