"""learner/training/checkpoint.py: a checkpoint is loaded exactly as it was saved, or not at all."""

import errno
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from building import SPACES, run_spec
from log_lines import LINES

from daedalus.learner.training.checkpoint import encode_checkpoint, load_checkpoint, load_newest, save_checkpoint
from daedalus.policy.saving import sealed
from daedalus.policy.saving.regular_files import read_regular
from daedalus.policy.saving.saved_policy import FORMAT, OtherFormatError, checkpoints, find_policy
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, UnreadableError, write_sealed

SPEC = run_spec(algorithm="a3c", learning_rate=0.003, target_return=1.5)
COUNTERS = {
    "env_steps": 12,
    "returns": [1.5, -2.25],
    "lengths": [3, 9],
    "rollouts_rejected": {"stale": 3},
    "wall_seconds": 7.5,
}


def parameters(version: int) -> dict[str, np.ndarray]:
    return {"layer.weight": np.full((2, 3), version, np.float32), "layer.bias": np.arange(3, dtype=np.float32)}


def state(version: int) -> dict[str, torch.Tensor]:
    return {"optimizer/mean": torch.full((9,), version / 3), "optimizer/steps": torch.tensor(version)}


def save(run: Path, version: int, keep: int = 9, **replaced: Any) -> Path:
    content: dict[str, Any] = {
        "spec": SPEC,
        "spaces": SPACES,
        "program": b"program of " + bytes([version]),
        "parameters": parameters(version),
        "state": state(version),
        "counters": COUNTERS,
    }
    return save_checkpoint(run, encode_checkpoint(policy_version=version, **{**content, **replaced}), keep=keep)


def names(run: Path) -> list[str]:
    return sorted(entry.name for entry in (run / "checkpoints").iterdir())


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def test_loaded_checkpoint_equals_the_saved_one(tmp_path: Path) -> None:
    save(tmp_path, 7)
    loaded = load_newest(tmp_path)
    assert loaded.policy.policy_version == 7
    assert loaded.policy.spec == SPEC
    assert loaded.policy.spaces == SPACES
    assert loaded.policy.program == b"program of \x07"
    assert loaded.counters == COUNTERS
    assert loaded.policy.weights.keys() == parameters(7).keys()
    for name, array in parameters(7).items():
        np.testing.assert_array_equal(loaded.policy.weights[name], array)
    assert loaded.state.keys() == state(7).keys()
    for name, value in state(7).items():
        assert torch.equal(loaded.state[name], value)
        assert loaded.state[name].dtype == value.dtype


def test_load_newest_names_a_damaged_checkpoint_and_returns_the_previous_one(tmp_path: Path) -> None:
    save(tmp_path, 1)
    flip(save(tmp_path, 2) / "parameters.safetensors", -1)
    assert load_newest(tmp_path).policy.policy_version == 1
    assert len(LINES) == 1
    assert "0000000002" in LINES[0]
    assert "parameters.safetensors" in LINES[0]


def test_damaged_checkpoints_are_no_longer_the_newest_after_a_resume(tmp_path: Path) -> None:
    """Only the learner's state is damaged, which nothing else reads."""
    for version in (1, 2, 3):
        save(tmp_path, version)
    for version in (2, 3):
        flip(tmp_path / "checkpoints" / f"{version:010d}" / "learner.safetensors", 20)
    assert find_policy(tmp_path, newest=True).policy_version == 3
    assert load_newest(tmp_path).policy.policy_version == 1
    assert find_policy(tmp_path, newest=True).policy_version == 1
    assert [directory.name for directory in checkpoints(tmp_path)] == ["0000000001"]
    (line,) = LINES
    assert "0000000002" in line
    assert "0000000003" in line
    assert len(names(tmp_path)) == 3  # their files can be looked at until the learner saves again
    flip(save(tmp_path, 2) / "learner.safetensors", 20)
    assert names(tmp_path) == ["0000000001", "0000000002"]
    assert load_newest(tmp_path).policy.policy_version == 1


@pytest.mark.parametrize("name", ["manifest.json", "parameters.safetensors"])
@pytest.mark.parametrize(
    ("error", "advice"),
    [
        (errno.EACCES, "let the user of this process read it"),
        (errno.EIO, "the file may be whole: try again"),
        (errno.ESTALE, "the file may be whole: try again"),
        (errno.EMFILE, "the file may be whole: try again"),
    ],
)
def test_checkpoint_that_cannot_be_read_now_is_not_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, error: int, advice: str
) -> None:
    save(tmp_path, 1)
    newest = save(tmp_path, 2)

    def read(path: Path, limit: int) -> bytes:  # a test may run as root, who may read everything
        if path == newest / name:
            raise OSError(error, os.strerror(error), str(path))
        return read_regular(path, limit)

    monkeypatch.setattr(sealed, "read_regular", read)
    expected = f"{newest / name}: {os.strerror(error)}: {advice}, or remove {newest} to continue without it"
    with pytest.raises(UnreadableError, match=f"^{re.escape(expected)}$"):
        load_newest(tmp_path)
    assert newest.is_dir()


def test_learner_resumes_although_a_damaged_checkpoint_cannot_be_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 1)
    flip(save(tmp_path, 2) / "learner.safetensors", 20)

    def refusing(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "replace", refusing)
    assert load_newest(tmp_path).policy.policy_version == 1
    _, line = LINES
    assert line.startswith(f"{tmp_path / 'checkpoints' / '0000000002'} cannot be set aside: Read-only file system")


def test_load_newest_raises_when_no_checkpoint_is_undamaged(tmp_path: Path) -> None:
    with pytest.raises(DamagedError, match="no readable checkpoint"):
        load_newest(tmp_path)
    for version in (1, 2):
        flip(save(tmp_path, version) / "seal", 0)
    with pytest.raises(DamagedError, match="no readable checkpoint"):
        load_newest(tmp_path)
    (line,) = LINES
    assert "0000000001" in line
    assert "0000000002" in line
    assert [directory.name for directory in checkpoints(tmp_path)] == ["0000000002", "0000000001"]


def test_run_of_another_format_is_refused_and_its_checkpoints_are_not_called_damaged(tmp_path: Path) -> None:
    for version in (1, 2):
        directory = save(tmp_path, version)
        sealed = SealedDirectory(directory)
        files = {name: sealed.read(name, 1 << 20) for name in FILES if name not in ("manifest.json", "seal")}
        write_sealed(directory, files, {**sealed.content, "format": FORMAT - 1})
    with pytest.raises(OtherFormatError, match=rf"has format {FORMAT - 1} of checkpoints.* reads format {FORMAT} only"):
        load_newest(tmp_path)
    assert not LINES


@pytest.mark.parametrize(
    "counters",
    [
        *({**COUNTERS, "annealing": {"budget": "x"}}, {**COUNTERS, "annealing": {"other": 3}}),
        *(None, [], {}, {**COUNTERS, "env_steps": "x"}, {**COUNTERS, "updates": -1}, {**COUNTERS, "returns": 1.0}),
        *({**COUNTERS, "rollouts_rejected": {"stale": 2**70}}, {**COUNTERS, "wall_seconds": float("nan")}),
    ],
)
def test_checkpoint_with_counters_that_are_none_is_damaged(tmp_path: Path, counters: Any) -> None:
    directory = save(tmp_path, 1, counters=counters)
    with pytest.raises(DamagedError, match=re.escape(str(directory))):
        load_checkpoint(directory)


FILES = ["learner.safetensors", "manifest.json", "parameters.safetensors", "program.onnx", "seal"]


@pytest.mark.parametrize("name", FILES)
def test_damage_to_any_file_is_detected(name: str, tmp_path: Path) -> None:
    path = save(tmp_path, 1) / name
    assert sorted(entry.name for entry in path.parent.iterdir()) == FILES
    whole = path.read_bytes()
    places = {0, 8, len(whole) // 3, len(whole) // 2, len(whole) - 1}
    damaged = [whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :] for place in places]
    damaged += [whole[: len(whole) // 2], whole[:-1], b"", whole + b"\0", bytes(len(whole))]
    for data in damaged:
        path.write_bytes(data)
        with pytest.raises(DamagedError):
            load_checkpoint(path.parent)
    path.unlink()
    with pytest.raises(DamagedError):
        load_checkpoint(path.parent)
    path.write_bytes(whole)
    load_checkpoint(path.parent)


def test_older_checkpoints_are_pruned_and_the_highest_version_is_the_newest(tmp_path: Path) -> None:
    for version in (1, 2, 9, 10, 4):
        save(tmp_path, version, keep=3)
    assert names(tmp_path) == ["0000000004", "0000000009", "0000000010"]
    (tmp_path / "checkpoints" / ".0000000011.123.partial").mkdir()  # unfinished
    assert [each.name for each in checkpoints(tmp_path)] == ["0000000010", "0000000009", "0000000004"]
    save(tmp_path, 10, counters={**COUNTERS, "env_steps": 99})  # the same version may be saved again
    newest = load_newest(tmp_path)
    assert (newest.policy.policy_version, newest.counters["env_steps"]) == (10, 99)


def test_only_checkpoints_of_ours_are_removed(tmp_path: Path) -> None:
    home, folder = tmp_path / "home", tmp_path / "checkpoints"
    for path in (home, folder / "2024", folder / "0000000002", folder / ".config"):
        path.mkdir(parents=True)
        (path / "photo").write_text("precious")
    (folder / "0000000003").symlink_to(home)
    (folder / ".0000000000.77.partial").mkdir()
    for version in (4, 5, 6):
        save(tmp_path, version, keep=1)
    assert names(tmp_path) == [".config", "0000000002", "0000000003", "0000000006", "2024"]
    assert len(list(tmp_path.rglob("photo"))) == 4


def test_saved_checkpoint_is_kept_when_a_damaged_one_has_a_higher_version(tmp_path: Path) -> None:
    save(tmp_path, 10)
    flip(save(tmp_path, 20) / "seal", 0)
    saved = save(tmp_path, 11, keep=1)  # by a learner that resumed from version 10
    assert saved.is_dir()
    assert load_newest(tmp_path).policy.policy_version == 11


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("written", range(6))  # three files, manifest, seal, and the directory itself
def test_full_disk_leaves_only_the_previous_checkpoint(
    version: int, written: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 1)
    fsync, left = os.fsync, iter(range(written))

    def filling(descriptor: int) -> None:
        if next(left, None) is None:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    monkeypatch.setattr("daedalus.policy.saving.sealed.os.fsync", filling)
    with pytest.raises(OSError, match="No space left"):
        save(tmp_path, version, keep=1)
    monkeypatch.undo()
    assert names(tmp_path) == ["0000000001"]
    assert load_newest(tmp_path).counters == COUNTERS


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("aside", [False, True])
def test_failed_rename_leaves_only_the_previous_checkpoint(
    version: int, aside: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 1)
    rename = os.replace

    def refusing(source: Path, target: Path) -> None:
        """Refuse to replace a directory. With `aside`, moving the previous directory away and back is allowed."""
        if source.name.endswith(".partial") or not aside:
            raise OSError(errno.EIO, "Input/output error")
        rename(source, target)

    monkeypatch.setattr("daedalus.policy.saving.sealed.os.replace", refusing)
    with pytest.raises(OSError, match="Input/output"):
        save(tmp_path, version, keep=1)
    monkeypatch.undo()
    assert names(tmp_path) == ["0000000001"]
    assert load_newest(tmp_path).counters == COUNTERS
