"""Metrics of the program that started the run, and the rows that it receives. Both go through pipes of its process."""

import json
import math
import os
import threading
from collections.abc import Mapping
from contextlib import suppress

from daedalus.learner.reporting.metrics_rows import USER, Details
from daedalus.protocol.keys import is_name

MOST_METRICS = 64  # between two rows


class UserMetrics:
    """Newest metrics of the program, until a row takes them. Used by two threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._metrics: dict[str, float] = {}

    def add_line(self, line: bytes) -> None:
        """Add metrics from a JSON object of names and finite numbers; ignore anything else."""
        try:
            metrics = json.loads(line)
        except ValueError:
            return
        with self._lock:
            for name, value in metrics.items() if isinstance(metrics, dict) else ():
                known = name in self._metrics or len(self._metrics) < MOST_METRICS
                if known and is_name(name) and isinstance(value, int | float) and math.isfinite(value):
                    self._metrics[name] = float(value)

    def take(self) -> dict[str, float]:
        """Return the columns for the next row."""
        with self._lock:
            metrics, self._metrics = self._metrics, {}
        return {USER + name: value for name, value in metrics.items()}


class RowsWriter:
    """Metrics writer that passes rows to the program, as lines of JSON. If the program does not read, rows are lost."""

    def __init__(self, descriptor: int) -> None:
        """Construct the writer over a pipe that does not block."""
        self._descriptor = descriptor

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Write a row. See MetricsWriter."""
        with suppress(OSError):  # full, or the program has ended
            os.write(self._descriptor, json.dumps(dict(row)).encode() + b"\n")

    def close(self) -> None:
        """Leave the pipe open: the writers may be opened again. See MetricsWriter."""
