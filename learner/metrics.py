"""Where metrics go: a CSV file, TensorBoard, both, or nowhere."""

import csv
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

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
    "policy_loss",
    "value_loss",
    "entropy",
    "explained_variance",
    "gradient_norm",
    "value_mean",
    "advantage_std",
    "learning_rate",
    "entropy_bonus",
)


class MetricsWriter(Protocol):
    """Takes one row of metrics at a time."""

    def write(self, row: Mapping[str, float]) -> None:
        """Records a row; its keys are among COLUMNS, and those it lacks are unknown yet."""
        ...

    def close(self) -> None:
        """Brings all to the disk."""
        ...


class NullWriter:
    """Records nothing."""

    def write(self, row: Mapping[str, float]) -> None:
        """See MetricsWriter."""

    def close(self) -> None:
        """See MetricsWriter."""


class CsvWriter:
    """One line a row, appended; a resumed run continues its file."""

    def __init__(self, path: Path) -> None:
        new = not path.exists() or path.stat().st_size == 0
        self._file = open(path, "a", newline="", encoding="utf-8")  # noqa: SIM115 - closed in close()
        self._writer = csv.writer(self._file)
        if new:
            self._writer.writerow(COLUMNS)

    def write(self, row: Mapping[str, float]) -> None:
        """See MetricsWriter."""
        self._writer.writerow([_cell(row.get(name)) for name in COLUMNS])
        self._file.flush()

    def close(self) -> None:
        """See MetricsWriter."""
        self._file.close()


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


class TensorBoardWriter:
    """Scalars against env_steps, in TensorBoard's own files."""

    def __init__(self, directory: Path) -> None:
        # Loaded here: a quarter of a second that no run should wait for before it has begun.
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        # protobuf makes these classes when it is loaded: no type checker finds them
        self._event: Any = vars(event_pb2)["Event"]
        self._summary: Any = vars(summary_pb2)["Summary"]
        self._writer = EventFileWriter(str(directory))

    def write(self, row: Mapping[str, float]) -> None:
        """See MetricsWriter."""
        values: list[Any] = [
            self._summary.Value(tag=name, simple_value=float(value))
            for name, value in row.items()
            if name != "env_steps"
        ]
        self._writer.add_event(
            self._event(wall_time=time.time(), step=int(row["env_steps"]), summary=self._summary(value=values))
        )

    def close(self) -> None:
        """See MetricsWriter."""
        self._writer.close()


class MetricsWriters:
    """Several as one."""

    def __init__(self, writers: Sequence[MetricsWriter]) -> None:
        self._writers = writers

    def write(self, row: Mapping[str, float]) -> None:
        """See MetricsWriter."""
        for writer in self._writers:
            writer.write(row)

    def close(self) -> None:
        """See MetricsWriter."""
        for writer in self._writers:
            writer.close()
