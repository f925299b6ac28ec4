"""Files of policies: sealed directories, regular files only, and files that are replaced as a whole."""

import errno
import hashlib
import json
import math
import os
import re
import shutil
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from plain import vector_spaces

from daedalus.policy.saving.regular_files import (
    append_own,
    foreign_entry,
    open_own,
    open_regular,
    read_regular,
    replace_text,
    replacing,
)
from daedalus.policy.saving.saved_policy import (
    FORMAT,
    PARAMETERS_FILE,
    PROGRAM_FILE,
    NoPolicyError,
    OtherFormatError,
    find_policy,
    read_policy,
)
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, write_sealed

FILES = {"weights": bytes(range(40)), "program": b"onnx", "empty": b""}
LIMIT = 40  # bytes of the largest of FILES
CONTENT = {"policy_version": 3, "note": "é", "nested": {"list": [1, None, 2.5]}}


def read_all(directory: Path) -> tuple[dict[str, bytes], dict[str, Any]]:
    sealed = SealedDirectory(directory)
    return {name: sealed.read(name, LIMIT) for name in FILES}, sealed.content


def is_damaged(directory: Path) -> bool:
    """Assert that reading all files raises a DamagedError that names the directory, and no other exception."""
    with pytest.raises(DamagedError, match=re.escape(str(directory))):
        read_all(directory)
    return True


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    write_sealed(tmp_path / "0001", FILES, CONTENT)
    return tmp_path / "0001"


def test_written_files_are_read_back(sealed: Path) -> None:
    assert read_all(sealed) == (FILES, CONTENT)
    assert sorted(entry.name for entry in sealed.iterdir()) == ["empty", "manifest.json", "program", "seal", "weights"]
    assert [entry.name for entry in sealed.parent.iterdir()] == ["0001"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no FIFOs in folders")
@pytest.mark.parametrize("name", ["empty", "manifest.json", "program", "seal", "weights"])
def test_file_that_is_not_regular_is_damaged(sealed: Path, name: str) -> None:
    """A checkpoint may come from another machine."""
    (sealed / name).unlink()
    (sealed / name).symlink_to("/dev/zero")
    assert is_damaged(sealed)
    (sealed / name).unlink()
    os.mkfifo(sealed / name)
    assert is_damaged(sealed)


def test_manifest_is_plain_json(sealed: Path) -> None:
    manifest = json.loads((sealed / "manifest.json").read_bytes())
    assert manifest["content"] == CONTENT
    assert {name: entry["bytes"] for name, entry in manifest["files"].items()} == {
        name: len(data) for name, data in FILES.items()
    }


# ------------------------------------------------------------------------------------------------ damage

WRITTEN = [name for name, data in FILES.items() if data] + ["manifest.json", "seal"]


@pytest.mark.parametrize("name", [*WRITTEN, "empty"])
def test_file_that_is_flipped_truncated_longer_missing_or_a_folder_is_detected(sealed: Path, name: str) -> None:
    whole = (sealed / name).read_bytes()
    damaged = [whole[:length] for length in range(len(whole))] + [whole + b"\0"]
    for position in range(len(whole)):
        torn = bytearray(whole)
        torn[position] ^= 1 << position % 8
        damaged.append(bytes(torn))
    for data in damaged:
        (sealed / name).write_bytes(data)
        assert is_damaged(sealed)
    (sealed / name).write_bytes(whole)
    assert read_all(sealed) == (FILES, CONTENT)
    (sealed / name).unlink()
    assert is_damaged(sealed)
    (sealed / name).mkdir()
    assert is_damaged(sealed)


def test_missing_directory_is_reported_as_damaged(tmp_path: Path) -> None:
    assert is_damaged(tmp_path / "absent")
    (tmp_path / "file").write_bytes(b"")
    assert is_damaged(tmp_path / "file")


def test_unknown_file_name_is_rejected(sealed: Path) -> None:
    for name in ("other", "manifest.json", "../0001/weights"):
        with pytest.raises(DamagedError, match=f"{re.escape(str(sealed))}: no file"):
            SealedDirectory(sealed).read(name, LIMIT)


def test_file_that_is_larger_than_its_limit_is_not_read(sealed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Anybody can write a manifest with a right seal, and a file of any size that takes no room on the disk."""
    monkeypatch.setattr(Path, "stat", lambda path: pytest.fail(f"{path} was looked at"))
    with pytest.raises(DamagedError, match=r"weights has 40 bytes, the limit is 39"):
        SealedDirectory(sealed).read("weights", LIMIT - 1)


def test_manifest_of_another_directory_is_detected(sealed: Path) -> None:
    write_sealed(sealed.parent / "0002", {**FILES, "weights": bytes(40)}, CONTENT)
    for name in ("manifest.json", "seal"):
        shutil.copy(sealed.parent / "0002" / name, sealed / name)
    assert is_damaged(sealed)


def test_huge_manifest_is_not_read(sealed: Path) -> None:
    manifest = (sealed / "manifest.json").read_bytes().ljust((16 << 20) + 1)
    (sealed / "manifest.json").write_bytes(manifest)
    (sealed / "seal").write_text(hashlib.sha256(manifest).hexdigest())
    assert is_damaged(sealed)


# ------------------------------------------------------------------------------------------- failing disks

Failing = Callable[[str, int], None]


@pytest.fixture
def disk_full(monkeypatch: pytest.MonkeyPatch) -> Failing:
    """Return disk_full(call, n): makes the n-th call (from 0) of that function of `os` fail, and all later calls."""

    def arrange(call: str, allowed: int) -> None:
        working, left = getattr(os, call), [allowed]

        def refuse(*arguments: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            return working(*arguments)

        monkeypatch.setattr(os, call, refuse)

    return arrange


# Every file, the manifest, the seal and the directory are synced before the rename.
REFUSALS = [("fsync", allowed) for allowed in range(len(FILES) + 3)] + [("replace", 0)]


@pytest.mark.parametrize(("call", "allowed"), REFUSALS)
def test_failed_write_leaves_no_files(tmp_path: Path, disk_full: Failing, call: str, allowed: int) -> None:
    write_sealed(tmp_path / "0001", FILES, CONTENT)
    disk_full(call, allowed)
    with pytest.raises(OSError, match="No space left"):
        write_sealed(tmp_path / "0002", FILES, CONTENT)
    assert [entry.name for entry in tmp_path.iterdir()] == ["0001"]
    assert read_all(tmp_path / "0001") == (FILES, CONTENT)


@pytest.mark.parametrize(("call", "allowed"), REFUSALS)
def test_failed_overwrite_keeps_the_older_directory(sealed: Path, disk_full: Failing, call: str, allowed: int) -> None:
    disk_full(call, allowed)
    with pytest.raises(OSError, match="No space left"):
        write_sealed(sealed, dict.fromkeys(FILES, b"new"), {})
    assert [entry.name for entry in sealed.parent.iterdir()] == ["0001"]
    assert read_all(sealed) == (FILES, CONTENT)


def test_directory_is_complete_if_syncing_the_rename_fails(sealed: Path, disk_full: Failing) -> None:
    newer = dict.fromkeys(FILES, b"new")
    disk_full("fsync", len(FILES) + 3)
    with pytest.raises(OSError, match="No space left"):
        write_sealed(sealed, newer, CONTENT)
    assert [entry.name for entry in sealed.parent.iterdir()] == ["0001"]
    assert read_all(sealed) in ((newer, CONTENT), (FILES, CONTENT))


def test_overwrite_replaces_all_files(sealed: Path) -> None:
    newer = {name: b"newer" + data[5:] for name, data in FILES.items() if name != "program"}
    write_sealed(sealed, newer, {"policy_version": 4})
    reread = SealedDirectory(sealed)
    assert {name: reread.read(name, LIMIT) for name in newer} == newer
    assert reread.content == {"policy_version": 4}
    assert not (sealed / "program").exists()
    assert [entry.name for entry in sealed.parent.iterdir()] == ["0001"]


def test_leftovers_of_an_earlier_attempt_are_replaced(tmp_path: Path) -> None:
    leftover = tmp_path / f".0001.{os.getpid()}.partial"
    leftover.mkdir()
    (leftover / "old").write_bytes(b"junk")
    write_sealed(tmp_path / "0001", FILES, CONTENT)
    assert [entry.name for entry in tmp_path.iterdir()] == ["0001"]
    assert not (tmp_path / "0001" / "old").exists()


# -------------------------------------------------------------------------------------- the policy in it

POLICY_CONTENT: dict[str, Any] = {
    "format": FORMAT,
    "policy_version": 7,
    "spec": {"environment": {"id": "CartPole-v1"}},
    "spaces": vector_spaces(4, 2).model_dump(mode="json"),
}
POLICY_FILES = {PROGRAM_FILE: b"program", PARAMETERS_FILE: safetensors.numpy.save({"w": np.ones(3, np.float32)})}


@pytest.mark.parametrize(
    "changed",
    [
        *({"policy_version": value} for value in (None, "seven", -1, 2**63, True, math.inf)),
        *({"spec": value} for value in ({}, {**POLICY_CONTENT["spec"], "new_section": {}})),
        *({"spaces": value} for value in (None, {})),
        *({name: "absent"} for name in POLICY_CONTENT if name != "format"),
    ],
)
def test_policy_of_another_release_is_rejected_with_its_directory(tmp_path: Path, changed: dict[str, Any]) -> None:
    content = {name: value for name, value in (POLICY_CONTENT | changed).items() if value != "absent"}
    write_sealed(tmp_path / "0007", POLICY_FILES, content)
    with pytest.raises(DamagedError, match=re.escape(str(tmp_path / "0007"))):
        read_policy(tmp_path / "0007")


@pytest.mark.parametrize("number", [None, FORMAT + 1, "x" * 99])
def test_policy_of_another_format_is_refused_with_both_formats(tmp_path: Path, number: object) -> None:
    """Releases before the number existed wrote format 1: their spaces and programs are others."""
    content = {name: value for name, value in POLICY_CONTENT.items() if name != "format"}
    run = tmp_path / "run"
    for version in (1, 2):
        directory = run / "checkpoints" / f"{version:010d}"
        write_sealed(directory, POLICY_FILES, content if number is None else {**content, "format": number})
    expected = str(1 if number is None else number)[:20]
    for read in (read_policy, find_policy):
        with pytest.raises(
            OtherFormatError, match=rf"0000000002 has format {expected} of .* reads format {FORMAT} only"
        ):
            read(run if read is find_policy else directory)
    newer = {**content, "format": FORMAT + 1, "release": "daedalus-rl 99.1"}
    write_sealed(tmp_path / "newer", POLICY_FILES, newer)
    with pytest.raises(OtherFormatError, match=r"daedalus-rl 99\.1 wrote it, which is newer than this one, "):
        read_policy(tmp_path / "newer")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("patience", r"environment\.no_reward_limit replaces environment\.patience"),
        ("newer", r"setting environment\.newer"),
    ],
)
def test_a_setting_of_another_release_is_named(tmp_path: Path, name: str, text: str) -> None:
    environment = {**POLICY_CONTENT["spec"]["environment"], name: 7}
    write_sealed(tmp_path / "7", POLICY_FILES, {**POLICY_CONTENT, "spec": {"environment": environment}})
    with pytest.raises(DamagedError, match=rf"written by another release \(.*{text}\)"):
        read_policy(tmp_path / "7")


def test_a_directory_without_a_policy_is_named_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(NoPolicyError, match=r"nowhere does not exist: name a run directory or one of its checkpoints"):
        find_policy(tmp_path / "nowhere")
    with pytest.raises(NoPolicyError, match=r"has no checkpoints: is it a run directory\?"):
        find_policy(tmp_path)
    (tmp_path / "config.toml").touch()
    with pytest.raises(NoPolicyError, match=r"has no checkpoints yet: .* service\.checkpoint_seconds"):
        find_policy(tmp_path)


@pytest.mark.parametrize("weights", [b"", b"junk", bytes(100)])
def test_weights_that_are_not_safetensors_are_rejected(tmp_path: Path, weights: bytes) -> None:
    write_sealed(tmp_path / "0007", {**POLICY_FILES, PARAMETERS_FILE: weights}, POLICY_CONTENT)
    with pytest.raises(DamagedError, match="another release"):
        read_policy(tmp_path / "0007")


@pytest.mark.parametrize(
    "manifest",
    [
        b"",
        b"not json",
        b"[]",
        b"null",
        b"{}",
        b'{"files": {}}',
        b'{"files": [], "content": {}}',
        b'{"files": {"a": 1}, "content": {}}',
        b'{"files": {"a": {"bytes": "many", "sha256": "x"}}, "content": {}}',
        b'{"files": {"a": {}}, "content": {}}',
        b'{"files": {}, "content": []}',
        b"[" * 100_000,
        b"\xff\xfe",
    ],
)
def test_manifest_of_another_form_under_a_right_seal_is_reported_as_damaged(tmp_path: Path, manifest: bytes) -> None:
    (tmp_path / "manifest.json").write_bytes(manifest)
    (tmp_path / "seal").write_text(hashlib.sha256(manifest).hexdigest())
    with pytest.raises(DamagedError, match=str(tmp_path)):
        SealedDirectory(tmp_path)


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


def test_a_file_keeps_its_content_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    replace_text(path, "old")
    with replacing(path) as beside:
        beside.write_bytes(b"new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_error_keeps_the_old_file_and_leaves_no_other(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "config.toml"
    path.write_text("old")

    def fail() -> None:
        with replacing(path) as beside:
            beside.write_text("ne")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("private", [False, True])
def test_others_cannot_read_a_private_file_while_it_is_written_either(tmp_path: Path, *, private: bool) -> None:
    path = tmp_path / "token"
    with replacing(path, private=private) as beside:
        modes = [beside.stat().st_mode]
        beside.write_text("secret")
    modes.append(path.stat().st_mode)
    assert [bool(stat.S_IMODE(mode) & 0o077) for mode in modes] == [not private] * 2


def test_a_missing_folder_is_an_error_that_names_a_file_in_it(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        replace_text(tmp_path / "nowhere" / "text", "text")
