"""One file with everything to repeat or resume a run: a plain tar archive with a checksum of each file.

An archive is hostile input. It is not compressed, so that nothing in it is larger than the archive itself, and tarfile
extracts nothing: each header is read alone, 512 bytes at a time, and whatever is not a regular file with the name of a
part of a run is refused before anything is written. `archive.json`, the last member, has the checksums: an archive that
was cut has none."""

import hashlib
import os
import re
import shutil
import stat
import tarfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from pydantic import BaseModel, ValidationError

from daedalus.analysis.run_selection import one_run
from daedalus.learner.reporting.trackers.tracker import flat
from daedalus.learner.run import run_directory as names
from daedalus.learner.run.heartbeat import HEARTBEAT
from daedalus.learner.run.run_lock import LOCK, lock_idle
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.regular_files import open_regular
from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.policy.saving.sealed import MANIFEST, DamagedError, SealedDirectory
from daedalus.policy.user_modules import module_of
from daedalus.protocol.keys import is_name
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import bounded_text, is_secret, listed

FORMAT = 1
REPLAY = "replay"  # folder of a replay buffer (learner/training/replay_files.py, which needs torch)
_CONTENTS = "archive.json"
_MOST_FILES, _MAX_CONTENTS_BYTES = 20_000, 8 << 20
_LARGEST_FILE = (8 << 30) - 1  # bytes that a header of this kind can state
_BLOCK, _COPIED = tarfile.BLOCKSIZE, 1 << 20
_MOST_NAMED = 10  # files, for a person
_LATEST = 1 << 33  # of a file's time, in seconds since 1970
_TEXTS = (
    *(names.CONFIG, names.VERSIONS, names.SUMMARY, names.METRICS, names.EVALUATION, names.EVENTS, names.LABELS),
    *(names.REPORT, names.OUTPUT, f"{names.OUTPUT}.1", names.CONFIRMATION_OUTPUT, f"{names.CONFIRMATION_OUTPUT}.1"),
)
_FOLDERS = ("checkpoints", names.LEAGUE, names.DEMONSTRATIONS, REPLAY)  # of sealed directories
_SEALED = rf"(?:{'|'.join(_FOLDERS)})/\w[\w.+-]*/(?:manifest\.json|seal|rollout|[a-z]+\.(?:onnx|safetensors))"
_OTHERS = r"tracker-\w[\w.-]*\.json|events\.out\.\w[\w.-]*|\w[\w .+()-]*\.(?:mp4|gif)"
_PART = re.compile("|".join([*map(re.escape, _TEXTS), _OTHERS, _SEALED]), re.ASCII)
_PARTIAL = re.compile(r"\..*\.partial").fullmatch
_OF_A_PROCESS = {LOCK, HEARTBEAT, names.OPERATOR_TOKEN}  # of a learner, and the token of a page: they are not kept


class ArchiveError(Exception):
    """Error for an archive that cannot be written, or not be used. The message is one line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """A file in an archive."""

    path: str  # in the run directory
    begin: int  # of its content in the archive, in bytes
    size: int
    modified: int  # seconds since 1970


@dataclass(frozen=True, slots=True, kw_only=True)
class RunArchive:
    """An archive whose headers and list of contents are checked. `verify` and `restore` check the contents."""

    path: Path
    run: str  # the name of the run
    release: str  # that wrote it
    members: Sequence[Member]
    sha256: Mapping[str, str]  # of each member
    left_out: Sequence[str]  # what of the run directory is not in it

    @property
    def size(self) -> int:
        """Bytes of the run directory."""
        return sum(member.size for member in self.members)

    def verify(self) -> None:
        """Compare all contents with their checksums. Raises ArchiveError."""
        with _opened(self.path) as file:
            for member in self.members:
                self._copy(file, member, lambda _: None)

    def restore(self, target: Path) -> None:
        """Write the run directory, which must not exist, with verified contents; after an error nothing remains.

        Raises ArchiveError.
        """
        check_new(target)
        partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(target.parent).free
            if free < self.size:
                raise ArchiveError(f"{target.parent} has {free:,} bytes of room, and the run {self.size:,}: make room")
            partial.mkdir(0o700)
            try:
                with _opened(self.path) as file:
                    for member in self.members:
                        self._write(file, member, partial / member.path)
                check_new(target)
                partial.rename(target)
            except BaseException:
                shutil.rmtree(partial, ignore_errors=True)
                raise
        except OSError as error:
            raise ArchiveError(f"{target} cannot be written: {error.strerror or error}") from None

    def _write(self, file: BinaryIO, member: Member, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        private = path.suffix == ".log"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        with open(os.open(path, flags, 0o600 if private else 0o666), "wb") as written:
            self._copy(file, member, written.write)
            written.flush()
            os.fsync(written.fileno())
        os.utime(path, (member.modified, member.modified))

    def _copy(self, file: BinaryIO, member: Member, write: Callable[[bytes], object]) -> None:
        file.seek(member.begin)
        digest, left = hashlib.sha256(), member.size
        while left and (data := file.read(min(left, _COPIED))):
            digest.update(data)
            write(data)
            left -= len(data)
        if left or digest.hexdigest() != self.sha256[member.path]:
            raise ArchiveError(
                f"{self.path} is damaged: {member.path} differs from its checksum; copy the archive again"
            )


def check_new(path: Path) -> None:
    """Raise ArchiveError if a path exists."""
    if path.exists() or path.is_symlink():
        raise ArchiveError(f"{path} exists and is left as it is: choose another name, or remove it")


def parts_of(directory: Path) -> tuple[list[Path], list[str]]:
    """Return the files of a run that are kept, and the names of what else is in its directory, both sorted.

    What a process has for itself, or has not finished, is neither. Raises OSError.
    """
    files, others = list[Path](), list[str]()
    for entry in sorted(directory.iterdir()):
        is_ours = entry.name in _FOLDERS and entry.is_dir() and not entry.is_symlink()
        for each in sorted(entry.rglob("*")) if is_ours else [entry]:
            path, mode = each.relative_to(directory).as_posix(), each.lstat().st_mode
            if _PART.fullmatch(path) and stat.S_ISREG(mode):
                files.append(each)
            elif not ((is_ours and (stat.S_ISDIR(mode) or "/." in path)) or path in _OF_A_PROCESS or _PARTIAL(path)):
                others.append(path)
    return files, others


def write_archive(directory: Path, output: Path, *, replay: bool) -> tuple[RunArchive, list[str]]:
    """Write the archive of a run that no process trains, verify it, and return it, and what a person has to know.

    Args:
      directory: the run directory; it is locked meanwhile.
      output: the file; it must not exist, and after an error it does not.
      replay: include the replay buffer, if there is one.

    Raises ArchiveError, RunDataError, and SettingsError for a run that is in use or has links.
    """
    one_run(directory)
    check_new(output)
    with lock_idle(directory):
        files, others = parts_of(directory)
        kept = [file for file in files if replay or not _is_replay(file, directory)]
        buffer = [file for file in files if _is_replay(file, directory)]
        if len(kept) > _MOST_FILES:
            raise ArchiveError(f"{directory} has more than {_MOST_FILES:,} files: remove what is not needed")
        left_out = [*others, *([REPLAY] if len(kept) < len(files) else [])]
        try:
            descriptor = os.open(output, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o600)
        except OSError as error:
            raise ArchiveError(f"{output} cannot be written: {error.strerror}") from None
        try:
            with open(descriptor, "wb") as file:
                sha256 = _write(file, directory, kept, left_out)
            written = read_archive(output)
            written.verify()
        except OSError as error:
            output.unlink(missing_ok=True)
            raise ArchiveError(f"{error.filename or output}: {error.strerror or error}; no archive is left") from None
        except BaseException:
            output.unlink(missing_ok=True)
            raise
        notes = [f"not in it, because no run has such a file: {listed_paths(others)}"] if others else []
        if buffer:
            size = sum(file.stat().st_size for file in buffer) / 2**20
            notes.append(
                f"the replay buffer, {size:,.1f} MiB, is in it; --no-replay leaves it out"
                if replay
                else f"the replay buffer, {size:,.1f} MiB, is not in it: a resumed run begins with an empty one"
            )
        return written, [*notes, *_damaged(directory, kept, sha256), *_needed(directory)]


def listed_paths(paths: Sequence[str]) -> str:
    """Return the first of some paths, which somebody else may have chosen, in one line, and how many more there are."""
    return listed([bounded_text(path) for path in paths], _MOST_NAMED)


def _is_replay(file: Path, directory: Path) -> bool:
    return file.relative_to(directory).parts[0] == REPLAY


def _write(file: BinaryIO, directory: Path, kept: Sequence[Path], left_out: Sequence[str]) -> dict[str, str]:
    """Write an archive, and return the checksums of its members. Raises OSError, ArchiveError."""
    from daedalus import __version__

    run, sha256 = names.run_name(directory), dict[str, str]()
    with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for path in kept:
            name = path.relative_to(directory).as_posix()
            with open_regular(path) as source:
                found, hashing = os.fstat(source.fileno()), _Hashing(source)
                if found.st_size > _LARGEST_FILE:
                    raise ArchiveError(f"{path} has more than 8 GiB, the most that a file of an archive may have")
                try:
                    archive.addfile(_header(f"{run}/{name}", found.st_size, int(found.st_mtime)), hashing)
                except ValueError:
                    raise ArchiveError(f"{path} has a name of more than 100 characters: rename the file") from None
            sha256[name] = hashing.digest.hexdigest()
        contents = _Contents(format=FORMAT, run=run, release=__version__, files=sha256, left_out=list(left_out))
        data = contents.model_dump_json(indent=1).encode()
        archive.addfile(_header(f"{run}/{_CONTENTS}", len(data), 0), BytesIO(data))
    file.flush()
    os.fsync(file.fileno())
    return sha256


class _Hashing:
    """A file that is read once, with the checksum of what was read."""

    def __init__(self, source: BinaryIO) -> None:
        self._source, self.digest = source, hashlib.sha256()

    def read(self, size: int = -1, /) -> bytes:
        data = self._source.read(size)
        self.digest.update(data)
        return data


def _header(name: str, size: int, modified: int) -> tarfile.TarInfo:
    header = tarfile.TarInfo(name)  # of nobody: names of users and hosts are not in it
    header.size, header.mtime, header.mode = size, min(max(modified, 0), _LATEST), 0o644
    return header


def _damaged(directory: Path, kept: Sequence[Path], sha256: Mapping[str, str]) -> Iterator[str]:
    """Yield a line about each checkpoint or part of the buffer that was damaged already when it was archived."""
    for folder in sorted({file.parent for file in kept if file.name == MANIFEST}):
        name = folder.relative_to(directory).as_posix()
        try:
            stated = SealedDirectory(folder).checksums
        except DamagedError as error:
            yield f"damaged in the run itself, and so in the archive: {error}"
            continue
        if any(sha256.get(f"{name}/{file}") != digest for file, digest in stated.items()):
            yield f"damaged in the run itself, and so in the archive: {name}"


def _needed(directory: Path) -> Iterator[str]:
    """Yield a line about each thing that a reader of the archive needs besides it, or may not read."""
    try:
        spec = names.read_config(directory)
    except SettingsError as error:
        yield f"its settings cannot be read by this release: {error}"
        return
    if modules := module_names(spec):
        yield f"not in it: the modules {', '.join(modules)}, which the run imports: take their files along"
    for name in secret_settings(spec):
        yield f"{names.CONFIG}, which is in it, holds a password or a token: {name}; keep the archive secret"
    if not checkpoints(directory):
        yield "the run has no checkpoint: it can be repeated from its settings, but not resumed or evaluated"


def secret_settings(spec: RunSpec) -> list[str]:
    """Return the names of the settings that hold a password or a token."""
    values = [each for each in flat(spec.model_dump(mode="json")) if isinstance(each[1], str | list)]
    return [name for name, value in values if is_secret(name.rpartition(".")[2], str(value))]


def module_names(spec: RunSpec) -> list[str]:
    """Return the modules that the settings of a run name."""
    named = [*spec.user_modules.values(), *spec.environment.user_modules.values()]
    named += [name for name in spec.league.opponents if ":" in name]
    return sorted({module_of(value) for value in named})


# ---------------------------------------------------------------------------------------------- reading


class _Head(BaseModel):
    format: int
    release: str = ""


class _Contents(_Head):
    """What archive.json holds."""

    run: str
    files: dict[str, str]  # SHA-256 by path
    left_out: list[str] = []


def read_archive(path: Path) -> RunArchive:
    """Return an archive, of which only the headers and the list of contents are read. Raises ArchiveError."""
    with _opened(path) as file:
        try:
            members = list(_scanned(path, file))
            if not members or members[-1].path.rpartition("/")[2] != _CONTENTS:
                raise ArchiveError(f"{path} is damaged: it has no {_CONTENTS} at its end; copy the archive again")
            contents = _contents(path, file, members.pop())
        except OSError as error:
            raise ArchiveError(f"{path}: {error.strerror or error}") from None
    run, prefix = contents.run, f"{contents.run}/"
    found = [member.path.removeprefix(prefix) for member in members if member.path.startswith(prefix)]
    if not is_name(run) or len(found) < len(members) or len({each.lower() for each in found}) < len(found):
        raise ArchiveError(f"{path} is not an archive of one run: its names do not agree")
    if sorted(found) != sorted(contents.files):
        raise ArchiveError(f"{path} is damaged: its files are not those that {_CONTENTS} lists")
    if unknown := [name for name in found if not _PART.fullmatch(name)]:
        raise ArchiveError(
            f"{path} has {unknown[0][:100]!r}, which is no part of a run: it was changed, or a newer release wrote it "
            f"({contents.release[:20]!r})"
        )
    return RunArchive(
        path=path,
        run=run,
        release=bounded_text(contents.release, 40),
        members=[
            Member(path=name, begin=member.begin, size=member.size, modified=member.modified)
            for name, member in zip(found, members, strict=True)
        ],
        sha256=contents.files,
        left_out=contents.left_out,
    )


def _opened(path: Path) -> BinaryIO:
    try:
        return open_regular(path)
    except FileNotFoundError:
        raise ArchiveError(f"{path} does not exist: name an archive that `daedalus runs archive` wrote") from None
    except OSError as error:
        raise ArchiveError(f"{path}: {error.strerror}") from None


def _scanned(path: Path, file: BinaryIO) -> Iterator[Member]:
    """Yield the members of an archive, with their whole names. Raises ArchiveError, OSError."""
    end, position = os.fstat(file.fileno()).st_size, 0
    for count in range(_MOST_FILES + 2):
        file.seek(position)
        block = file.read(_BLOCK)
        if count and block == bytes(_BLOCK):
            return
        try:
            header = tarfile.TarInfo.frombuf(block, "ascii", "strict")
        except (tarfile.TarError, ValueError):
            what = "is damaged: it ends too early, or was changed" if count else "is not an archive of a run"
            raise ArchiveError(f"{path} {what}") from None
        if header.type != tarfile.REGTYPE:
            raise ArchiveError(
                f"{path} has {header.name[:100]!r}, which is not a regular file: it is not an archive of a run"
            )
        position += _BLOCK
        if not 0 <= header.size <= end - position:
            raise ArchiveError(f"{path} is damaged: it ends within {header.name[:100]!r}; copy the archive again")
        modified = min(max(int(header.mtime), 0), _LATEST)
        yield Member(path=header.name, begin=position, size=header.size, modified=modified)
        position += -(-header.size // _BLOCK) * _BLOCK
    raise ArchiveError(f"{path} has more than {_MOST_FILES:,} files, which no run has")


def _contents(path: Path, file: BinaryIO, member: Member) -> _Contents:
    if member.size > _MAX_CONTENTS_BYTES:
        raise ArchiveError(f"{path} is damaged: its {_CONTENTS} is larger than {_MAX_CONTENTS_BYTES >> 20} MiB")
    file.seek(member.begin)
    data = file.read(member.size)
    try:
        head = _Head.model_validate_json(data)
        if head.format != FORMAT:
            raise ArchiveError(
                f"{path} has format {str(head.format)[:20]} of archives, and this release reads format {FORMAT}: "
                f"restore it with the release that wrote it ({head.release[:20]!r}), or a newer one"
            )
        return _Contents.model_validate_json(data)
    except ValidationError:
        raise ArchiveError(f"{path} is damaged: its {_CONTENTS} cannot be read") from None
