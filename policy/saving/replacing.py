"""Files that are replaced in one step: a reader sees the old content or the new, and a full disk keeps the old."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: Path, *, private: bool = False) -> Iterator[Path]:
    """Yield the path of a new, empty file, which takes the place of `path` at the end; after an error it is removed.

    Args:
      path: it keeps its content, if it exists, until then.
      private: only its owner may read the new file.

    Raises OSError.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with suppress(FileNotFoundError):  # of a process of this number, or a link of somebody else
            beside.unlink()
        os.close(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if private else 0o666))
        yield beside
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def replace_text(path: Path, text: str, *, private: bool = False) -> None:
    """Write a text in UTF-8, as `replacing` does. Raises OSError."""
    with replacing(path, private=private) as beside:
        beside.write_text(text, "utf-8")
