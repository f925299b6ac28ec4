"""The replay buffer on the disk: the folder `replay` of a run directory, with a part for what each checkpoint added.

A part is a sealed directory (policy/saving/sealed.py) of columns, which is written once and never changed: a save
costs what has been added since the last one, whatever the size of the buffer. Parts whose columns have all been
dropped are removed, so that the folder is no larger than the buffer, but for one part.
"""

import errno
import logging
import math
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
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, UnreadableError, remove_sealed, write_sealed

_logger = logging.getLogger(__name__)

FOLDER = "replay"
_COLUMNS_FILE = "columns.safetensors"
_PART_BYTES = 64 << 20  # about the largest part
_MOST_COPIED = 1 << 30
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
        self._loaded: dict[str, int] = {}  # columns of the buffer up to each part that was loaded
        # Columns of the buffer, over all that were added, up to which they are saved, and up to which that has begun.
        self._saved = self._begun = 0

    def load(self, beat: Callable[[], None] = lambda: None) -> None:
        """Fill the buffer with what is saved, oldest first. A damaged part is left out, with a warning.

        `beat` is called before each part. Raises UnreadableError for a part that may be whole, and, in one line,
        CheckpointMismatchError for a buffer of another run, or of other spaces or rollouts.
        """
        parts = list(self._parts())
        for path, _ in parts:
            beat()
            try:
                self._buffer.add_columns(self._read(path))
            except UnreadableError:
                raise
            except DamagedError as error:
                _logger.warning("a part of the replay buffer is left out: %s", error)
            self._loaded[path.name] = self._buffer.columns_added
        self._saved = self._begun = self._buffer.columns_added
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
            rows = ", ".join(map(str, content.columns.get("rewards", ("", []))[1]))
            raise CheckpointMismatchError(
                f"{path} has columns of other shapes than this run's: restore collection.rollout_length={rows}, or "
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

        At most a gigabyte is copied at a time; the rest is for the next calls. What writes raises OSError on a disk
        error, and if what was begun before it has failed; the columns are then saved with the next ones.
        """
        buffer = self._buffer
        oldest, begun = max(buffer.columns_added - buffer.columns, 0), self._begun
        if self._saved and not self._folder.is_dir():  # moved or removed: all is written again
            begun = self._saved = oldest
        first = max(begun, oldest)
        column = sum(math.prod(shape) * dtype.itemsize for shape, dtype in buffer.shapes().values())
        step = max(_PART_BYTES // column, 1)
        after = min(buffer.columns_added, first + max(_MOST_COPIED // column, 1))
        arrays = buffer.copied(first, after)
        content = {"run": self._learner.replay_identity, "columns": self._shapes()}
        self._begun = after

        def write() -> None:
            if self._saved != begun:
                raise OSError(errno.EIO, "those before are not saved")
            try:
                for begin in range(first, after, step):
                    end = min(begin + step, after)
                    part = {
                        name: np.ascontiguousarray(each[begin - first : end - first]) for name, each in arrays.items()
                    }
                    name = f"{begin + self._skipped:012d}-{end + self._skipped:012d}"
                    write_sealed(self._folder / name, {_COLUMNS_FILE: safetensors.numpy.save(part)}, content)
                    self._saved = end
            except OSError:
                self._begun = self._saved
                raise
            self._saved = after
            for path, end in list(self._parts()):
                if self._loaded.get(path.name, end - self._skipped) > oldest:
                    break
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
