"""Where metrics go: a CSV file, TensorBoard, or both."""

import csv
import io
import itertools
import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

COLUMNS = (
    "wall_seconds",
    "env_steps",
    "updates",
    "episodes",
    "episode_return_mean",
    "episode_return_std",
    "episode_return_min",
    "episode_return_max",
    "episode_length_mean",
    "env_steps_per_second",
    "updates_per_second",
    "policy_lag_mean",
    "policy_lag_max",
    "actors",
    "rollouts_accepted",
    "rollouts_rejected",
    "updates_skipped",
    "policy_loss",
    "value_loss",
    "entropy",
    "explained_variance",
    "gradient_norm",
    "value_mean",
    "advantage_std",
    "clipped_fraction",
    "evaluation_return_mean",
    "evaluation_return_std",
    "evaluation_length_mean",
    "evaluation_env_steps",
    "learning_rate",
    "entropy_bonus",
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Details:
    """What does not fit into a row of numbers and yet tells convergence apart from collapse."""

    returns: Sequence[float] = ()  # of the newest episodes
    lengths: Sequence[int] = ()
    action_counts: Sequence[int] = ()  # since the details before
    picture: np.ndarray | None = None  # what the network saw at one row: uint8 [H, W] or [H, W, 3]


class MetricsWriter(Protocol):
    """Takes one row of metrics at a time."""

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Records a row; its keys are among COLUMNS, and those it lacks are unknown yet."""
        ...

    def close(self) -> None:
        """Brings all to the disk."""
        ...


class CsvWriter:
    """One line a row, appended; a resumed run continues its file, in the columns that it was begun with.

    A line is there whole or not at all, also where the disk takes only a part of it.
    """

    def __init__(self, path: Path) -> None:
        begun = _header(path)  # another release may have had other columns
        self._columns = begun or COLUMNS
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 - closed in close()
        if not begun:
            self._append(COLUMNS)

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """See MetricsWriter."""
        self._append([_cell(row.get(name)) for name in self._columns])

    def _append(self, cells: Sequence[str]) -> None:
        line = io.StringIO()
        csv.writer(line).writerow(cells)
        data = line.getvalue().encode()
        before = os.fstat(self._file.fileno()).st_size
        try:
            written = self._file.write(data)
            if written != len(data):
                self._file.write(data[written:])  # says why there was no room for the rest
        except OSError:
            self._file.truncate(before)
            raise

    def close(self) -> None:
        """See MetricsWriter."""
        self._file.close()


def _header(path: Path) -> Sequence[str]:
    """The columns of a file; none if it is empty or not there."""
    if not path.exists():
        return ()
    with open(path, newline="", encoding="utf-8") as file:
        return next(csv.reader(file), ())


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


class TensorBoardWriter:
    """Scalars, distributions and pictures against env_steps, in TensorBoard's own files.

    Its record writer without its event writer: that one writes on a thread which dies of a full disk, and which waits
    for an hour where the clock is set back by one.
    """

    _numbers = itertools.count()

    def __init__(self, directory: Path) -> None:
        # Loaded here: a quarter of a second that no run should wait for before it has begun.
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        # protobuf makes these classes when it is loaded: no type checker finds them
        self._event: Any = vars(event_pb2)["Event"]
        self._summary: Any = vars(summary_pb2)["Summary"]
        self._histogram_proto: Any = vars(summary_pb2)["HistogramProto"]
        now = time.time()
        name = f"events.out.tfevents.{int(now):010d}.{socket.gethostname()}.{os.getpid()}.{next(self._numbers)}"
        self._writer = RecordWriter(open(directory / name, "ab"))  # noqa: SIM115 - closed in close()
        self._add(self._event(wall_time=now, file_version="brain.Event:2"))

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """See MetricsWriter."""
        values: list[Any] = [
            self._summary.Value(tag=name, simple_value=float(value))
            for name, value in row.items()
            if name != "env_steps"
        ]
        values += [
            self._summary.Value(tag=tag, histo=self._histogram(*np.histogram(numbers, bins=30), numbers))
            for tag, numbers in (("episode_return", details.returns), ("episode_length", details.lengths))
            if len(numbers)
        ]
        if sum(details.action_counts):
            chosen = np.array(details.action_counts)
            edges = np.arange(len(chosen) + 1) - 0.5
            values.append(self._summary.Value(tag="action", histo=self._histogram(chosen, edges, ())))
        if details.picture is not None:
            values.append(self._summary.Value(tag="what_the_network_sees", image=self._image(details.picture)))
        self._add(self._event(wall_time=time.time(), step=int(row["env_steps"]), summary=self._summary(value=values)))

    def _add(self, event: Any) -> None:
        self._writer.write(event.SerializeToString())
        self._writer.flush()

    def _histogram(self, counts: np.ndarray, edges: np.ndarray, numbers: Sequence[float]) -> Any:
        """TensorBoard's histogram of counts between edges; sums are of the numbers themselves where there are any."""
        middles = (edges[1:] + edges[:-1]) / 2
        exact = np.array(numbers, np.float64) if len(numbers) else np.repeat(middles, counts)
        return self._histogram_proto(
            min=float(exact.min()),
            max=float(exact.max()),
            num=float(counts.sum()),
            sum=float(exact.sum()),
            sum_squares=float(np.square(exact).sum()),
            bucket_limit=edges[1:].tolist(),
            bucket=counts.astype(float).tolist(),
        )

    def _image(self, picture: np.ndarray) -> Any:
        from PIL import Image  # a requirement of TensorBoard's

        png = io.BytesIO()
        Image.fromarray(picture).save(png, "png")
        return self._summary.Image(
            height=picture.shape[0],
            width=picture.shape[1],
            colorspace=1 if picture.ndim == 2 else 3,
            encoded_image_string=png.getvalue(),
        )

    def close(self) -> None:
        """See MetricsWriter."""
        self._writer.close()


class MetricsWriters:
    """Several as one."""

    def __init__(self, writers: Sequence[MetricsWriter]) -> None:
        self._writers = writers

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """See MetricsWriter."""
        for writer in self._writers:
            writer.write(row, details)

    def close(self) -> None:
        """See MetricsWriter."""
        for writer in self._writers:
            writer.close()
