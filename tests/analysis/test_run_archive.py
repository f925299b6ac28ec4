"""`daedalus runs archive` and `restore`: a round trip, what is left out, and archives that somebody has changed."""

import json
import re
import socket
import tarfile
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recorded_runs import record
from saved_runs import CARTPOLE, save
from test_run_folder import said

import daedalus
from daedalus.analysis.run_archive import ArchiveError, read_archive
from daedalus.learner.run.run_directory import create
from daedalus.learner.run.run_lock import RunLock
from daedalus.policy.saving.sealed import write_sealed
from daedalus.protocol.spec import RunSpec


def contents(directory: Path) -> dict[str, tuple[bytes, int]]:
    files = [path for path in directory.rglob("*") if path.is_file() and path.name != "learner.lock"]
    return {path.relative_to(directory).as_posix(): (path.read_bytes(), int(path.stat().st_mtime)) for path in files}


def test_a_restored_run_is_the_run_and_plays(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = save(record(folder / "runs" / "mine"), CARTPOLE, 3, 7)
    (run / "replay" / "000000000000-000000000064").mkdir(parents=True)
    (run / "replay" / "000000000000-000000000064" / "columns.safetensors").write_bytes(bytes(1000))
    write_sealed(run / "demonstrations" / "00000000", {"rollout": b"a rollout"}, {})
    (run / "my replay (2).mp4").write_bytes(b"a video")
    said(capsys, "tag", "paper", "runs/mine")
    before = contents(run)
    written = said(capsys, "archive", "runs/mine", "mine.tar")
    assert "all checksums are right" in written
    assert "the replay buffer, 0.0 MiB, is in it" in written
    assert (folder / "mine.tar").stat().st_mode & 0o777 == 0o600
    assert "all checksums are right" in said(capsys, "show", "mine.tar")
    said(capsys, "restore", "mine.tar", "elsewhere/again")
    assert contents(folder / "elsewhere" / "again") == before
    assert (folder / "elsewhere" / "again").stat().st_mode & 0o777 == 0o700
    policies = [daedalus.load_policy(path) for path in ("runs/mine", "elsewhere/again")]
    assert [policy.policy_version for policy in policies] == [7, 7]
    run.rename(folder / "moved")
    said(capsys, "restore", "mine.tar")  # into runs/ by its name
    assert contents(run) == before
    with tarfile.open("mine.tar") as archive:  # others can read it without us
        archive.extractall(folder / "plain", filter="data")
    assert (folder / "plain" / "mine" / "config.toml").read_bytes() == before["config.toml"][0]


def test_what_is_not_the_run_s_own_stays_out_and_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = folder / "run"
    spec = {
        "environment": {"id": "corridor:Corridor-v0", "kwargs": {"api_key": "abcdefghij"}},
        "policy": {"encoder": "my_nets:Net"},
    }
    create(run, RunSpec.model_validate(spec))
    save(run, CARTPOLE, 1)
    for name in ("operator-token", "heartbeat", "corridor.py", ".env", "certs/learner/key.pem", "wandb/run/log.txt"):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text("secret-of-mine")
    (run / "checkpoints" / "0000000001" / "key.pem").write_text("secret-of-mine")
    (run / "replay" / "000000000000-000000000064").mkdir(parents=True)
    (run / "replay" / "000000000000-000000000064" / "columns.safetensors").write_bytes(bytes(1000))
    written = said(capsys, "archive", "run", "run.tar", "--no-replay")
    assert b"secret-of-mine" not in (folder / "run.tar").read_bytes()
    assert (
        "not in it, because no run has such a file: .env, certs, checkpoints/0000000001/key.pem, corridor.py" in written
    )
    assert "not in it: the modules corridor, my_nets, which the run imports" in written
    assert "config.toml, which is in it, holds a password or a token: environment.kwargs.api_key" in written
    assert "is not in it: a resumed run begins with an empty one" in written
    assert {path.partition("/")[0] for path in read_archive(Path("run.tar")).sha256} == {
        *("config.toml", "versions.json", "checkpoints")
    }


def test_a_run_that_is_damaged_is_archived_and_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = save(record(folder / "run"), CARTPOLE, 1, 2)
    (run / "checkpoints" / "0000000002" / "parameters.safetensors").write_bytes(b"cut")
    written = said(capsys, "archive", "run", "run.tar")
    assert "damaged in the run itself, and so in the archive: checkpoints/0000000002" in written
    assert "checkpoints/0000000001" not in written
    assert "it can be repeated from its settings, but not resumed" in said(
        capsys, "archive", str(record(folder / "plain")), "plain.tar"
    )


def test_a_file_whose_name_does_not_fit_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = record(folder / "run")
    (run / f"events.out.tfevents.1764300000.{'h' * 64}.12345.0").touch()  # of a host with the longest name
    assert ".12345.0 has a name of more than 100 characters: rename" in said(capsys, "archive", "run", "x", status=1)
    assert not (folder / "x").exists()


def test_texts_of_an_archive_are_shown_in_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left_out = ["a\nkeeps\x1b[31m", *(f"{number}" * 5000 for number in range(100))]
    (folder / "x.tar").write_bytes(made(ONE, release="1\n2" * 1000, left_out=left_out))
    lines = said(capsys, "show", "x.tar").splitlines()
    assert len(lines) == 3
    assert max(map(len, lines)) < 4000
    assert lines[1].startswith("  not in it: a keeps [31m, 00000")
    assert lines[1].endswith(" and 91 more")


def test_nothing_is_overwritten_and_a_running_run_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = record(folder / "run")
    (folder / "there.tar").write_text("mine")
    (folder / "link.tar").symlink_to("nowhere")
    for taken in ("there.tar", "link.tar"):
        assert f"{taken} exists and is left as it is" in said(capsys, "archive", "run", taken, status=1)
    assert "cannot be written: No such file" in said(capsys, "archive", "run", "none/x.tar", status=1)
    with RunLock(run):
        assert "is in use by process" in said(capsys, "archive", "run", "run.tar", status=1)
    (run / "log").symlink_to("/etc")
    assert "log is a link" in said(capsys, "archive", "run", "run.tar", status=1)
    (run / "log").unlink()
    assert "does not exist: name a run directory" in said(capsys, "archive", "nowhere", "run.tar", status=1)
    assert not (folder / "run.tar").exists()
    said(capsys, "archive", "run", "run.tar")
    before = contents(run)
    assert "run exists and is left as it is" in said(capsys, "restore", "run.tar", "run", status=1)
    (folder / "empty").mkdir()
    assert "empty exists and is left" in said(capsys, "restore", "run.tar", "empty", status=1)
    assert contents(run) == before
    assert (folder / "there.tar").read_text() == "mine"


def made(members: dict[str, bytes], *, listed: dict[str, str] | None = None, **contents: object) -> bytes:
    """Return an archive of the run x, whose checksums are right unless `listed` says otherwise."""
    sums = {name.removeprefix("x/"): sha256(data).hexdigest() for name, data in members.items()}
    about = {"format": 1, "run": "x", "release": "0.1.0", "files": sums if listed is None else listed, **contents}
    stream = BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for name, data in {**members, "x/archive.json": json.dumps(about).encode()}.items():
            header = tarfile.TarInfo(name)
            header.size = len(data)
            archive.addfile(header, BytesIO(data))
    return stream.getvalue()


ONE = {"x/config.toml": b"1"}


def with_header(change: Callable[[tarfile.TarInfo], None], form: Literal[0, 1, 2] = tarfile.USTAR_FORMAT) -> bytes:
    """Return an archive that begins with a header of our choice."""
    header = tarfile.TarInfo("x/config.toml")
    change(header)
    return header.tobuf(form) + made(ONE)


def of_type(kind: bytes, target: str = "") -> bytes:
    def change(header: tarfile.TarInfo) -> None:
        header.type, header.linkname = kind, target

    return with_header(change)


def large(header: tarfile.TarInfo) -> None:
    header.size = 1 << 40


def long_comment(header: tarfile.TarInfo) -> None:
    header.pax_headers = {"comment": "x" * 100_000}


def many() -> bytes:
    """Return an archive of many files, which takes a second: it is not made where the tests are only collected."""
    return made({f"x/events.out.{number}": b"" for number in range(20_001)})


HOSTILE: dict[str, tuple[bytes | Callable[[], bytes], str]] = {
    "no archive": (b"hello", "is not an archive of a run"),
    "empty": (b"", "is not an archive of a run"),
    "zeros": (bytes(10240), "is not an archive of a run"),
    "traversal": (made({"../../evil": b"1"}), "is not an archive of one run"),
    "traversal inside": (made({"x/../evil": b"1"}), "which is no part of a run"),
    "absolute": (made({"/tmp/evil": b"1"}), "is not an archive of one run"),
    "run with a path": (made(ONE, run="../x"), "is not an archive of one run"),
    "module": (made({"x/sitecustomize.py": b"1"}), "which is no part of a run"),
    "deep": (made({**ONE, "x/checkpoints/a/b/manifest.json": b"1"}), "which is no part of a run"),
    "symbolic link": (of_type(tarfile.SYMTYPE, "/etc/passwd"), "which is not a regular file"),
    "hard link": (of_type(tarfile.LNKTYPE, "/etc/passwd"), "which is not a regular file"),
    "device": (of_type(tarfile.CHRTYPE), "which is not a regular file"),
    "pipe": (of_type(tarfile.FIFOTYPE), "which is not a regular file"),
    "folder": (of_type(tarfile.DIRTYPE), "which is not a regular file"),
    "sparse": (of_type(tarfile.GNUTYPE_SPARSE), "which is not a regular file"),
    "long name": (of_type(tarfile.GNUTYPE_LONGNAME), "which is not a regular file"),
    "large header": (with_header(long_comment, tarfile.PAX_FORMAT), "which is not a regular file"),
    "large file": (with_header(large, tarfile.GNU_FORMAT), "it ends within 'x/config.toml'"),
    "twice": (made(ONE)[:1024] + made(ONE), "names do not agree"),
    "not listed": (made({**ONE, "x/metrics.csv": b""}, listed={"config.toml": "0"}), "are not those that"),
    "missing": (made({}, listed={"config.toml": "0"}), "are not those that"),
    "wrong checksum": (made(ONE, listed={"config.toml": "0" * 64}), "differs from its checksum"),
    "newer": (made(ONE, format=9, release="4.5.6"), "has format 9 of archives.*4.5.6"),
    "large format": (made(ONE, format=10**4000), "has format 10{19} of archives"),
    "no list": (made(ONE, files=7), "archive.json cannot be read"),
    "cut": (made(ONE)[:1024], "ends too early"),
    "many": (many, "has more than 20,000 files"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_archive_is_refused_in_one_line_before_anything_is_written(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    data, reason = HOSTILE[name]
    (folder / "hostile.tar").write_bytes(data() if callable(data) else data)
    error = said(capsys, "restore", "hostile.tar", "runs/new", status=1)
    assert error.startswith("daedalus runs: hostile.tar ")
    assert re.search(reason, error), error
    assert error.rstrip("\n").isprintable()
    assert [path.name for path in folder.rglob("*")] in (
        ["hostile.tar"],
        ["hostile.tar", "runs"],
        ["runs", "hostile.tar"],
    )
    assert said(capsys, "show", "hostile.tar", status=1) == error


def test_what_is_no_file_is_not_waited_for(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket.tar")
        assert "socket.tar" in said(capsys, "restore", "socket.tar", "new", status=1)
    assert "does not exist: name an archive" in said(capsys, "restore", "none.tar", "new", status=1)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100, deadline=None)
@given(position=st.integers(0, 10**6), value=st.integers(1, 255), cut=st.booleans())
def test_one_changed_byte_is_noticed_or_changes_nothing(folder: Path, position: int, value: int, cut: bool) -> None:
    data = bytearray(made({"x/config.toml": b"[environment]", "x/metrics.csv": b"a,b\n"}))
    position %= len(data)
    if cut:
        del data[position:]
    else:
        data[position] ^= value
    (folder / "changed.tar").write_bytes(data)
    with suppress(ArchiveError):
        archive = read_archive(folder / "changed.tar")
        archive.verify()
        right = {"config.toml": b"[environment]", "metrics.csv": b"a,b\n"}
        assert archive.sha256 == {name: sha256(data).hexdigest() for name, data in right.items()}


def test_a_full_disk_is_noticed_before_anything_is_written(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "run.tar").write_bytes(made(ONE))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=0))
    assert "0 bytes of room" in said(capsys, "restore", "run.tar", "new", status=1)
    assert not (folder / "new").exists()
