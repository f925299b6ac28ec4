"""Interface of an experiment tracker, and the trackers by name."""

import importlib
import importlib.util
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from daedalus.learner.reporting.metrics_rows import Details, MetricsWriter, tag
from daedalus.learner.run.run_directory import run_name

PROJECT = "daedalus"  # project or experiment of the runs, unless the tracker's environment variable names another
SUMMARY = "summary/"  # prefix of the results of a run

# The class of each tracker, and the package that it needs. The extra in pyproject.toml has the tracker's name.
_CLASSES = {
    "wandb": ("wandb_tracker", "WandbTracker"),
    "mlflow": ("mlflow_tracker", "MlflowTracker"),
    "trackio": ("trackio_tracker", "TrackioTracker"),
}
TRACKERS = tuple(_CLASSES)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedRun:
    """A run as a tracker receives it when it is opened."""

    directory: Path
    settings: Mapping[str, Any]  # of config.toml, by section and key
    id: str  # the tracker's id of the run, if an earlier process has logged it; else empty

    @property
    def name(self) -> str:
        """Name of the run."""
        return run_name(self.directory)


class Tracker(MetricsWriter, Protocol):
    """Metrics writer that also keeps the settings and the results of a run.

    It is opened by its class with a TrackedRun. All methods may raise any exception of the tracker's package.
    """

    id: str  # under which a later process continues the run
    place: str  # where the run is found, for a person

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Log a row at its env_steps. Details are not logged."""
        ...

    def summarize(self, summary: Mapping[str, Any]) -> None:
        """Log the results of the run: numbers and texts by name."""
        ...


OpenTracker = Callable[[TrackedRun], Tracker]


def tracker_class(name: str) -> OpenTracker:
    """Import the class of a tracker. Its constructor imports the package. Raises KeyError for an unknown name."""
    module, of = _CLASSES[name]
    return getattr(importlib.import_module(f"daedalus.learner.reporting.trackers.{module}"), of)


def is_installed(name: str) -> bool:
    """Return whether the package of a tracker is installed, without importing it."""
    found = importlib.util.find_spec(name)
    return found is not None and found.origin is not None  # a folder such as ./wandb is a package without origin


def tagged(row: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics of a row, without env_steps, by the names that TensorBoard shows too."""
    return {tag(name): float(value) for name, value in row.items() if name != "env_steps"}


def flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings by their names with dots between; leave out None."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        elif value is not None:
            yield prefix + name, value
