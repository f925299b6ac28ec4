"""Files of every kind, opened by a reader who does not know what they are."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from daedalus.policy.saving.regular_files import append_own, foreign_entry, open_own, open_regular, read_regular


def test_beginning_of_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"content")
    assert [read_regular(path, limit) for limit in (0, 3, 7, 2**60)] == [b"", b"con", b"content", b"content"]
    with open_regular(path) as file:
        file.seek(3)
        assert file.read() == b"tent"


def test_missing_file_and_folder_are_errors(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "missing", 10)
    with pytest.raises(OSError, match=r"directory|[Pp]ermission"):
        read_regular(tmp_path, 10)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no FIFOs in folders")
def test_other_kinds_of_files_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")  # nobody writes into it
    for path in (tmp_path / "fifo", Path("/dev/zero")):
        descriptors = len(os.listdir("/dev/fd"))
        with pytest.raises(OSError, match="not a regular file") as error:
            read_regular(path, 10)
        assert error.value.filename == str(path)
        assert len(os.listdir("/dev/fd")) == descriptors


def _bind(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(os.path.relpath(path))


VICTIM = b"precious"
FOREIGN: dict[str, Callable[[Path, Path], object]] = {
    "is a link": lambda path, victim: path.symlink_to(victim),
    "has a name elsewhere, too": lambda path, victim: path.hardlink_to(victim),
    "is not a regular file": lambda path, _: os.mkfifo(path),
    "is not a regular": lambda path, _: _bind(path),
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no FIFOs in folders")
@pytest.mark.parametrize("reason", FOREIGN)
def test_nothing_is_written_through_what_no_run_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    victim, run = tmp_path / "victim", tmp_path / "run"
    victim.write_bytes(VICTIM)
    (run / "checkpoints" / "0000000001").mkdir(parents=True)
    for path in (run / "metrics.csv", run / "checkpoints" / "0000000001" / "seal"):
        assert foreign_entry(run) == ""
        FOREIGN[reason](path, victim)
        shared = reason.startswith("has") and path.name == "seal"  # checkpoints have files in common
        relative = os.path.relpath(path, run)
        assert foreign_entry(run).startswith("" if shared else f"{relative} {reason}")
        for flags in (os.O_RDWR | os.O_CREAT, os.O_WRONLY | os.O_APPEND):
            with pytest.raises(OSError):  # noqa: PT011 - a FIFO and a socket have reasons of the system
                os.close(open_own(path, flags))
        path.unlink()
    assert victim.read_bytes() == VICTIM


def test_linked_folder_is_foreign_and_that_of_a_tracker_is_not_searched(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "wandb").mkdir(parents=True)
    (run / "wandb" / "latest-run").symlink_to(tmp_path)
    assert foreign_entry(run) == ""
    (run / "checkpoints").symlink_to(tmp_path)
    assert foreign_entry(run) == "checkpoints is a link: remove it, or copy the directory without it"


@pytest.mark.parametrize("name", ["config.toml", "evaluation.json", "metrics.csv", "learner.lock", "operator-token"])
def test_folder_where_a_run_has_a_file_is_foreign(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    assert foreign_entry(tmp_path).startswith(f"{name} is a folder, but a run has a file of this name: remove it")


def test_file_in_place_of_the_checkpoints_is_foreign(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").touch()
    assert foreign_entry(tmp_path).startswith("checkpoints is a file, but a run has a folder of this name: remove it")


def test_own_file_is_appended_to(tmp_path: Path) -> None:
    for _ in range(2):
        with append_own(tmp_path / "events.jsonl") as file:
            file.write(b"line\n")
    assert (tmp_path / "events.jsonl").read_bytes() == b"line\n" * 2
