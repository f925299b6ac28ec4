"""A sealed directory: files, and a manifest that tells whether they are whole.

Written beside its final place, synced to the disk, then renamed: it is there entirely or not at all. Every
file's size and SHA-256 stand in `manifest.json`, whose own are kept in `seal`; reading checks them before
anything is parsed. Nothing in it can execute: bytes, JSON, safetensors.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

_MANIFEST, _SEAL = "manifest.json", "seal"
_MAX_MANIFEST_BYTES = 16 << 20


class DamagedError(Exception):
    """A sealed directory that is not what was written."""


def write_sealed(directory: Path, files: dict[str, bytes], content: dict[str, Any]) -> None:
    """Writes `files` and `content` (kept in the manifest) as the sealed directory `directory`, atomically.

    Raises OSError if the disk refuses; then nothing is left behind.
    """
    entries = {name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in files.items()}
    manifest = json.dumps({"files": entries, "content": content}, indent=1).encode()
    seal = hashlib.sha256(manifest).hexdigest().encode()
    beside = directory.with_name(f".{directory.name}.{os.getpid()}.partial")
    shutil.rmtree(beside, ignore_errors=True)
    try:
        beside.mkdir(parents=True)
        for name, data in {**files, _MANIFEST: manifest, _SEAL: seal}.items():
            _write_synced(beside / name, data)
        _sync_directory(beside)
        _put_in_place(beside, directory)
        _sync_directory(directory.parent)
    except OSError:
        shutil.rmtree(beside, ignore_errors=True)
        raise


def _put_in_place(beside: Path, directory: Path) -> None:
    """Renames; what was there under that name (the same version, saved again) stays if that fails."""
    if not directory.exists():
        os.replace(beside, directory)
        return
    aside = directory.with_name(f".{directory.name}.{os.getpid()}.replaced")
    os.replace(directory, aside)
    try:
        os.replace(beside, directory)
    except OSError:
        os.replace(aside, directory)
        raise
    shutil.rmtree(aside, ignore_errors=True)


class SealedDirectory:
    """A sealed directory whose manifest was verified; files are verified as they are read."""

    def __init__(self, directory: Path) -> None:
        """Raises DamagedError, naming the directory, if the manifest is missing or was changed."""
        self._directory = directory
        try:
            if (directory / _MANIFEST).stat().st_size > _MAX_MANIFEST_BYTES:
                raise DamagedError(f"{directory}: the manifest is too large")
            manifest = (directory / _MANIFEST).read_bytes()
            seal = (directory / _SEAL).read_bytes()
        except OSError as error:
            raise DamagedError(f"{directory}: {error.strerror}: {error.filename}") from None
        if hashlib.sha256(manifest).hexdigest().encode() != seal:
            raise DamagedError(f"{directory}: the manifest is damaged")
        parsed = json.loads(manifest)
        self._files: dict[str, dict[str, Any]] = parsed["files"]
        self.content: dict[str, Any] = parsed["content"]

    def read(self, name: str) -> bytes:
        """The bytes of a file; raises DamagedError if they are not those that were written."""
        entry = self._files.get(name)
        if entry is None:
            raise DamagedError(f"{self._directory}: has no {name}")
        try:
            size = (self._directory / name).stat().st_size
            if size != entry["bytes"]:
                raise DamagedError(f"{self._directory / name}: {size} bytes, {entry['bytes']} were written")
            data = (self._directory / name).read_bytes()
        except OSError as error:
            raise DamagedError(f"{self._directory / name}: {error.strerror}") from None
        if hashlib.sha256(data).hexdigest() != entry["sha256"]:
            raise DamagedError(f"{self._directory / name}: damaged, its checksum differs")
        return data


def _write_synced(path: Path, data: bytes) -> None:
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync_directory(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
