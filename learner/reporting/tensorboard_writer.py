"""Metrics writer for TensorBoard event files."""

import contextlib
import io
import itertools
import os
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from daedalus.learner.reporting.metrics_rows import Details, tag
from daedalus.learner.reporting.thinning import merged
from daedalus.policy.saving.regular_files import append_own

_EVENTS = 2000  # the distance of events is this part of the age of the run, if that is longer than that of rows
_MOST_WAITING = 100  # rows, before they are merged
_BINS = 30  # of returns and lengths
_MOST_BINS = 256  # of actions
_SMALLEST_RANGE = 1e-12  # of values, relative to the largest: a float has few numbers within a smaller one


class TensorBoardWriter:
    """Writer of scalars, histograms and images against env_steps.

    The older the run, the rarer are its events, each with the rows since the one before merged: an event file can only
    grow. Details are written at once.

    It uses TensorBoard's record writer, but not its event writer: the thread of the event writer dies when the disk is
    full, and waits for an hour after the clock is set back by an hour.
    """

    _numbers = itertools.count()

    def __init__(self, directory: Path) -> None:
        # Imported here, because the import takes a quarter of a second that must not delay the start of a run.
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        # protobuf creates these classes at import, so a type checker cannot find them.
        self._event: Any = vars(event_pb2)["Event"]
        self._session_log: Any = vars(event_pb2)["SessionLog"]
        self._summary: Any = vars(summary_pb2)["Summary"]
        self._histogram_proto: Any = vars(summary_pb2)["HistogramProto"]
        now = time.time()
        name = f"events.out.tfevents.{int(now):010d}.{socket.gethostname()}.{os.getpid()}.{next(self._numbers)}"
        self._waiting: list[Mapping[str, float]] = []  # the rows since the last event
        self._written: Mapping[str, float] = {}  # the row of the last event
        self._due = 0.0  # when the next event is, in wall_seconds
        self._writer = RecordWriter(append_own(directory / name))
        try:
            self._add(self._event(wall_time=now, file_version="brain.Event:2"))
        except OSError:  # a full disk: whoever tries again later would leave one empty file after the other
            with contextlib.suppress(OSError):
                self._writer.close()
            (directory / name).unlink(missing_ok=True)
            raise

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Write one event if it is due. See MetricsWriter."""
        if len(self._waiting) == _MOST_WAITING:
            self._waiting = [merged(self._waiting, self._written)]
        self._waiting.append(dict(row))
        if row.get("wall_seconds", self._due) >= self._due or details.exist:
            self._write(details)

    def _write(self, details: Details) -> None:
        row, self._waiting = merged(self._waiting, self._written), []
        seconds = row.get("wall_seconds", 0.0)
        self._written, self._due = row, seconds + seconds / _EVENTS
        values: list[Any] = [
            self._summary.Value(tag=tag(name), simple_value=float(value))
            for name, value in row.items()
            if name != "env_steps"
        ]
        values += [
            self._summary.Value(
                tag=f"rollout/{name}", histo=self._histogram(*np.histogram(numbers, _edges(numbers)), numbers)
            )
            for name, numbers in (("episode_return", details.returns), ("episode_length", details.lengths))
            if len(numbers)
        ]
        for name, counts in details.action_counts.items():
            if sum(counts):
                under = "rollout/action" if name == "action" else f"rollout/action/{name}"
                values.append(self._summary.Value(tag=under, histo=self._histogram(*_merged(counts), ())))
        if details.picture is not None:
            values.append(self._summary.Value(tag="rollout/observation", image=self._image(details.picture)))
        self._add(self._event(wall_time=time.time(), step=int(row["env_steps"]), summary=self._summary(value=values)))

    def purge(self, env_steps: int) -> None:
        """Let TensorBoard forget what earlier files have after `env_steps`: the run goes on from there."""
        status = self._session_log(status=self._session_log.START)
        self._add(self._event(wall_time=time.time(), step=env_steps + 1, session_log=status))

    def _add(self, event: Any) -> None:
        self._writer.write(event.SerializeToString())
        self._writer.flush()

    def _histogram(self, counts: np.ndarray, edges: np.ndarray, numbers: Sequence[float]) -> Any:
        """Return TensorBoard's histogram of `counts` between `edges`.

        Its sums are exact if `numbers` is given, else they are computed from the middles of the bins.
        """
        middles = (edges[1:] + edges[:-1]) / 2
        values = np.array(numbers, np.float64) if len(numbers) else middles
        weights = np.ones(len(values)) if len(numbers) else counts
        seen = values[weights > 0]
        return self._histogram_proto(
            min=float(seen.min()),
            max=float(seen.max()),
            num=float(counts.sum()),
            sum=float((values * weights).sum()),
            sum_squares=float((np.square(values) * weights).sum()),
            bucket_limit=edges[1:].tolist(),
            bucket=counts.astype(float).tolist(),
        )

    def _image(self, picture: np.ndarray) -> Any:
        from PIL import Image  # installed with TensorBoard

        png = io.BytesIO()
        Image.fromarray(picture).save(png, "png")
        return self._summary.Image(
            height=picture.shape[0],
            width=picture.shape[1],
            colorspace=1 if picture.ndim == 2 else 3,
            encoded_image_string=png.getvalue(),
        )

    def close(self) -> None:
        """Close the file. See MetricsWriter."""
        try:
            if self._waiting:
                self._write(Details())
        finally:
            self._writer.close()


def _edges(numbers: Sequence[float]) -> np.ndarray:
    """Return the edges of the bins of some values, also if the values are equal or very large."""
    low, high = min(numbers), max(numbers)
    largest = max(abs(low), abs(high))
    if high - low <= _SMALLEST_RANGE * largest:
        margin = max(0.5, 1e-6 * largest)
        low, high = low - margin, high + margin
    return np.linspace(low, high, _BINS + 1)


def _merged(counts: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return counts of choices, those of neighbouring choices added up if there are many, and the edges between."""
    firsts = np.arange(0, len(counts), -(-len(counts) // _MOST_BINS))
    return np.add.reduceat(counts, firsts), np.append(firsts, len(counts)) - 0.5
