"""Interface of an experiment tracker, the trackers by name, and a metrics writer of the user's as one of them."""

import importlib
import importlib.util
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from daedalus.learner.reporting.metrics_rows import Details, MetricsWriter, tag
from daedalus.learner.run.run_directory import run_name
from daedalus.policy.user_modules import UserModules

PROJECT = "daedalus"  # project or experiment of the runs, unless the tracker's environment variable names another
SUMMARY = "summary/"  # prefix of the results of a run

# The class of each tracker in known_trackers.py. Its package and the extra in pyproject.toml have the tracker's name.
_CLASSES = {"wandb": "WandbTracker", "mlflow": "MlflowTracker", "trackio": "TrackioTracker"}
TRACKERS = tuple(_CLASSES)
_OPTION = "--log"


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


def tracker_name(name: str) -> str:
    """Return the name of a tracker or of the user's metrics writer, `module:Class`. Raises ValueError for another."""
    if name not in TRACKERS and re.fullmatch(r"\w+(\.\w+)*:\w+", name) is None:
        raise ValueError(f"unknown tracker {name!r}: choose from {', '.join(TRACKERS)}, or write module:Class")
    return name


def tracker_class(name: str) -> OpenTracker:
    """Import the class of a tracker; its constructor imports the package. The user has named it, if it is their own.

    Raises KeyError for an unknown name, UserModuleError if the user's class cannot be imported.
    """
    if ":" in name:
        modules = UserModules.of({_OPTION: name})
        kind = modules.attribute(_OPTION, name)
        return lambda run: OwnWriter(name, kind(run))
    return getattr(importlib.import_module("daedalus.learner.reporting.trackers.known_trackers"), _CLASSES[name])


class OwnWriter:
    """A metrics writer of the user's as a tracker that has no run of its own to continue."""

    id = ""

    def __init__(self, name: str, writer: MetricsWriter) -> None:
        self.place, self._writer = f"metrics go to {name}", writer

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """See MetricsWriter."""
        self._writer.write(row, details)

    def summarize(self, summary: Mapping[str, Any]) -> None:
        """Give the results to a writer that has this method. See Tracker."""
        if summarize := getattr(self._writer, "summarize", None):
            summarize(summary)

    def close(self) -> None:
        """See MetricsWriter."""
        self._writer.close()


def is_installed(name: str) -> bool:
    """Return whether the package of a tracker is installed, without importing it."""
    if ":" in name:  # of the user's own: its process reports a module that is missing
        return True
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
