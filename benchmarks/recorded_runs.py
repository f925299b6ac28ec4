"""A CSV file of runs that a benchmark extends: what is there is not measured again."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


class RecordedRuns:
    """Lines of a CSV file, found by the columns that identify a run.

    Args:
        path: The file. Its folder is made.
        identity: Columns that identify a run.
        results: The other columns.
    """

    def __init__(self, path: Path, identity: Sequence[str], results: Sequence[str]) -> None:
        self._path, self._identity, self._columns = path, tuple(identity), (*identity, *results)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            _remove_cut_line(path)
        else:
            path.write_text(",".join(self._columns) + "\n", encoding="utf-8")

    def read(self) -> list[dict[str, str]]:
        """Return all lines, by column."""
        with open(self._path, newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    def missing(self, runs: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
        """Return those runs that the file does not have."""
        have = {self._key(line) for line in self.read()}
        return [run for run in runs if self._key(run) not in have]

    def add(self, line: Mapping[str, Any]) -> None:
        """Append a run with its results."""
        with open(self._path, "a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self._columns, lineterminator="\n").writerow(line)

    def _key(self, line: Mapping[str, Any]) -> tuple[str, ...]:
        return tuple(str(line[column]) for column in self._identity)


def _remove_cut_line(path: Path) -> None:
    """Remove what an interrupted benchmark had written of a line."""
    content = path.read_bytes()
    path.write_bytes(content[: content.rfind(b"\n") + 1])
