"""Sealed directories: files with a manifest of their checksums.

A directory is written under a temporary name, synced to the disk and then renamed, so it exists completely or not at
all. `manifest.json` holds the size and SHA-256 of every file, and `seal` the SHA-256 of the manifest. Reading checks
them before anything is parsed. No content can execute: raw bytes, JSON and safetensors.
"""

import errno
import hashlib
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from daedalus.policy.saving.regular_files import read_regular

MANIFEST, SEAL = "manifest.json", "seal"
MAX_MANIFEST_BYTES = 16 << 20
_SEAL_BYTES = 64
# What the system answers where a file is missing or something else has its name. Any other error may pass, as those
# of a network's file system do.
_NO_SUCH_FILE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EINVAL, errno.ELOOP, errno.ENXIO})


class DamagedError(Exception):
    """A sealed directory that is missing, incomplete or changed."""


class UnreadableError(DamagedError):
    """A sealed directory that cannot be read now: another user owns it, or the disk has an error. It may be whole."""


def write_sealed(directory: Path, files: dict[str, bytes], content: dict[str, Any]) -> None:
    """Write a sealed directory atomically.

    Args:
      directory: its path; an existing directory is replaced.
      files: contents by file name.
      content: JSON values that are kept in the manifest.

    Raises OSError if writing fails; then no partial directory remains.
    """
    entries = {name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in files.items()}
    manifest = json.dumps({"files": entries, "content": content}, indent=1).encode()
    seal = hashlib.sha256(manifest).hexdigest().encode()
    partial = directory.with_name(f".{directory.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        for name, data in {**files, MANIFEST: manifest, SEAL: seal}.items():
            _write_synced(partial / name, data)
        _sync_directory(partial)
        _move_into_place(partial, directory)
        _sync_directory(directory.parent)
    except OSError:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def link_sealed(directory: Path, target: Path) -> None:
    """Create `target` with the files of a sealed directory, atomically; as hard links where the file system has them.

    Raises OSError if writing fails; then no partial directory remains.
    """
    partial = target.with_name(f".{target.name}")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir()
        for file in directory.iterdir():
            try:
                os.link(file, partial / file.name)
            except OSError:  # exFAT and many FUSE file systems have no hard links
                _write_synced(partial / file.name, file.read_bytes())
        _sync_directory(partial)
        os.replace(partial, target)
        _sync_directory(target.parent)
    except OSError:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def remove_sealed(directory: Path) -> None:
    """Remove a sealed directory. Anything else stays, such as a folder of the user with such a name, or a link."""
    if not directory.is_symlink() and all((directory / name).is_file() for name in (MANIFEST, SEAL)):
        shutil.rmtree(directory, ignore_errors=True)


def is_unfinished(directory: Path) -> bool:
    """Return whether a name is that of a sealed directory which was not finished, or was replaced or set aside."""
    return (
        re.fullmatch(r"\.(best_\S+_)?[0-9]{10,}(\.[0-9]+)?(\.(partial|replaced|damaged))?", directory.name) is not None
    )


def _move_into_place(partial: Path, directory: Path) -> None:
    """Rename `partial` to `directory`; restore an existing directory of that name if renaming fails."""
    if not directory.exists():
        os.replace(partial, directory)
        return
    replaced = directory.with_name(f".{directory.name}.{os.getpid()}.replaced")
    os.replace(directory, replaced)
    try:
        os.replace(partial, directory)
    except OSError:
        os.replace(replaced, directory)
        raise
    shutil.rmtree(replaced, ignore_errors=True)


class _File(BaseModel):
    bytes: int
    sha256: str


class _Manifest(BaseModel):
    """Contents of `manifest.json`: anybody can write a manifest with a right seal."""

    files: dict[str, _File]
    content: dict[str, Any]


class SealedDirectory:
    """A sealed directory with a verified manifest; each file is verified when it is read."""

    def __init__(self, directory: Path) -> None:
        """Raise DamagedError, naming the directory, if the manifest is missing or damaged."""
        self._directory = directory
        try:
            manifest = read_regular(directory / MANIFEST, MAX_MANIFEST_BYTES + 1)
            seal = read_regular(directory / SEAL, _SEAL_BYTES + 1)
        except OSError as error:
            raise _read_error(Path(error.filename or directory), error) from None
        if len(manifest) > MAX_MANIFEST_BYTES:
            raise DamagedError(f"{directory}: the manifest is too large")
        if hashlib.sha256(manifest).hexdigest().encode() != seal:
            raise DamagedError(f"{directory}: the manifest is damaged")
        try:
            parsed = _Manifest.model_validate_json(manifest)
        except ValidationError:
            raise DamagedError(f"{directory}: the manifest is not of this format") from None
        self._files = parsed.files
        self.content = parsed.content

    @property
    def checksums(self) -> dict[str, str]:
        """SHA-256 of each file besides the manifest, by its name."""
        return {name: file.sha256 for name, file in self._files.items()}

    def read(self, name: str, limit: int) -> bytes:
        """Return the bytes of a file. Raises DamagedError if it is missing, damaged or larger than `limit` bytes."""
        entry = self._files.get(name)
        if entry is None:
            raise DamagedError(f"{self._directory}: no file {name}")
        if entry.bytes > limit:
            raise DamagedError(f"{self._directory / name} has {entry.bytes:,} bytes, the limit is {limit:,}")
        try:
            size = (self._directory / name).stat().st_size
            if size != entry.bytes:
                raise DamagedError(f"{self._directory / name}: {size} bytes instead of {entry.bytes}")
            data = read_regular(self._directory / name, entry.bytes)
        except OSError as error:
            raise _read_error(self._directory / name, error) from None
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise DamagedError(f"{self._directory / name}: damaged: the checksum differs")
        return data


def _read_error(path: Path, error: OSError) -> DamagedError:
    if isinstance(error, PermissionError):
        return UnreadableError(f"{path}: {error.strerror}: let the user of this process read it")
    if error.errno not in _NO_SUCH_FILE:
        return UnreadableError(f"{path}: {error.strerror}: the file may be whole: try again")
    return DamagedError(f"{path}: {error.strerror}")


def _write_synced(path: Path, data: bytes) -> None:
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync_directory(directory: Path) -> None:
    if not hasattr(os, "O_DIRECTORY"):  # Windows opens no directories, and NTFS keeps a journal of them
        return
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
