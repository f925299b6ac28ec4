"""How far a tracker has logged a run: a small file in the run directory."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

from daedalus.learner.reporting.trackers.tracker import TRACKERS
from daedalus.learner.run.run_directory import TRACKER, read_json, write_json
from daedalus.learner.run.settings import SettingsError


@dataclass(slots=True, kw_only=True)
class TrackingState:
    """State of one tracker between two processes."""

    id: str = ""  # the tracker's id of the run; empty before the first start
    rows: int = 0  # rows of metrics.csv that need no further attention
    env_steps: int = -1  # of the newest row that was logged

    @classmethod
    def load(cls, directory: Path, name: str) -> Self:
        """Read the state of a tracker; a missing or damaged file is a new state."""
        try:
            content = read_json(_path(directory, name))
            return cls(id=str(content["id"]), rows=int(content["rows"]), env_steps=int(content["env_steps"]))
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
