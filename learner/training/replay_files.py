"""The replay buffer on the disk: the folder `replay` of a run directory, with a part for what each checkpoint added.

A part is a sealed directory (policy/saving/sealed.py) of columns, which is written once and never changed: a save
costs what has been added since the last one, whatever the size of the buffer. Parts whose columns have all been
dropped are removed, so that the folder is no larger than the buffer, but for one part.
"""

import itertools
import logging
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy
from pydantic import BaseModel, ValidationError

from daedalus.learner.run.resuming import CheckpointMismatchError
from daedalus.learner.training.replay_learner import ReplayLearner
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, remove_sealed, write_sealed

_logger = logging.getLogger(__name__)

FOLDER = "replay"
_COLUMNS_FILE = "columns.safetensors"
_PART_BYTES = 64 << 20  # about the largest part
_SLACK_BYTES = 64 << 10  # of a file, besides its arrays
_NAME = re.compile(r"([0-9]{12})-([0-9]{12})")  # its first column, and the one after its last, over the whole run


class _Content(BaseModel):
    """What the manifest of a part says of it."""

    run: int  # ReplayLearner.replay_identity
    columns: dict[str, tuple[str, list[int]]]  # data type and shape of each array of a column


class ReplayFiles:
    """The saved replay buffer of one run. `load` it once, then `begin` a save with each checkpoint."""

    def __init__(self, directory: Path, learner: ReplayLearner) -> None:
        """`directory` is that of the run."""
        self._folder, self._learner, self._buffer = directory / FOLDER, learner, learner.replay
        self._skipped = 0  # columns of the run that this process has not: the numbers of files count them, too
        self._saved = 0  # columns of the buffer, over all that were added, up to which they are saved

    def load(self) -> None:
        """Fill the buffer with what is saved, oldest first. A damaged part is left out, with a warning.

        Raises CheckpointMismatchError, in one line, for a buffer of another run, or of other spaces or rollouts.
        """
        parts = list(self._parts())
        for path, _ in parts:
            try:
                self._buffer.add_columns(self._read(path))
            except DamagedError as error:
                _logger.warning("a part of the replay buffer is left out: %s", error)
        self._saved = self._buffer.columns_added
        if parts:
            self._skipped = parts[-1][1] - self._saved
            _logger.info("replay buffer: %s transitions of %s", f"{len(self._buffer):,}", self._folder)

    def _parts(self) -> Iterator[tuple[Path, int]]:
        """Yield the parts, and the number of the column after each, oldest first."""
        for path in sorted(self._folder.iterdir()) if self._folder.is_dir() else ():
            if match := _NAME.fullmatch(path.name):
                yield path, int(match[2])

    def _read(self, path: Path) -> dict[str, np.ndarray]:
        """Return the columns of a part. Raises DamagedError, and CheckpointMismatchError as `load`."""
        part = SealedDirectory(path)
        try:
            content = _Content.model_validate(part.content)
        except ValidationError:
            raise DamagedError(f"{path}: the manifest is not that of a replay buffer") from None
        if content.run != self._learner.replay_identity:
            raise CheckpointMismatchError(
                f"{path} is of the replay buffer of another run: remove the folder {self._folder} to begin with an "
                "empty buffer"
            )
        shapes = self._shapes()
        if content.columns != shapes:
            raise CheckpointMismatchError(
                f"{path} has columns of other shapes than this run's: restore collection.rollout_length of the run, or "
                f"remove the folder {self._folder} to begin with an empty buffer"
            )
        one = sum(np.dtype(dtype).itemsize * int(np.prod(shape, dtype=np.int64)) for dtype, shape in shapes.values())
        data = part.read(_COLUMNS_FILE, max(_PART_BYTES, one) + _SLACK_BYTES)
        try:
            arrays = safetensors.numpy.load(data)
        except (ValueError, KeyError, safetensors.SafetensorError) as error:
            raise DamagedError(f"{path}: {type(error).__name__}") from None
        return _checked(path, arrays, shapes)

    def _shapes(self) -> dict[str, tuple[str, list[int]]]:
        return {name: (str(dtype), list(shape)) for name, (shape, dtype) in self._buffer.shapes().items()}

    def begin(self) -> Callable[[], None]:
        """Copy the columns that are not saved, between two updates, and return what writes them, on any thread.

        The next call is after the writing has ended. It raises OSError on a disk error; the columns are then saved with
        the next ones.
        """
        added = self._buffer.columns_added
        oldest = max(added - self._buffer.columns, 0)
        first = max(self._saved, oldest)
        arrays = self._buffer.copied(first, added)
        content = {"run": self._learner.replay_identity, "columns": self._shapes()}
        column = sum(values[:1].nbytes for values in arrays.values()) or 1
        step = max(_PART_BYTES // column, 1)

        def write() -> None:
            for begin in range(first, added, step):
                end = min(begin + step, added)
                part = {name: np.ascontiguousarray(each[begin - first : end - first]) for name, each in arrays.items()}
                name = f"{begin + self._skipped:012d}-{end + self._skipped:012d}"
                write_sealed(self._folder / name, {_COLUMNS_FILE: safetensors.numpy.save(part)}, content)
                self._saved = end
            for path, _ in itertools.takewhile(lambda part: part[1] <= oldest + self._skipped, self._parts()):
                remove_sealed(path)
            for unfinished in self._folder.glob(".*.partial"):  # left by a crash
                shutil.rmtree(unfinished, ignore_errors=True)

        return write


def _checked(
    path: Path, arrays: dict[str, np.ndarray], shapes: dict[str, tuple[str, list[int]]]
) -> dict[str, np.ndarray]:
    """Return the arrays. Raises DamagedError unless they are columns of these shapes, with finite numbers."""
    count = len(arrays["learned"]) if "learned" in arrays else 0
    found = {name: (str(each.dtype), [*each.shape]) for name, each in arrays.items()}
    if found != {name: (dtype, [count, *shape]) for name, (dtype, shape) in shapes.items()}:
        raise DamagedError(f"{path}: the arrays are not those of its manifest")
    if not all(np.isfinite(each).all() for each in arrays.values() if each.dtype == np.float32):
        raise DamagedError(f"{path}: it has numbers that are not finite")
    return arrays
