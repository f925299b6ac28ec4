"""policy/saving/best_checkpoints.py: which checkpoints are kept, and their names."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daedalus.policy.saving.best_checkpoints import (
    best_checkpoints,
    best_name,
    best_score,
    evaluation_result,
    keep_if_best,
    rescore,
    set_aside_newer,
)
from daedalus.policy.saving.sealed import write_sealed
from daedalus.protocol.spec import EnvironmentSpec


def checkpoint(run: Path, version: int) -> Path:
    directory = run / "checkpoints" / f"{version:010d}"
    write_sealed(directory, {"content": str(version).encode()}, {})
    return directory


def scored(run: Path) -> list[tuple[float, str]]:
    return [(best_score(each), (each / "content").read_text()) for each in best_checkpoints(run)]


def test_scores_are_read_back_from_names(tmp_path: Path) -> None:
    for score, name in ((812.34, "best_812.34_0000012345"), (-20.5, "best_-20.5_0000012345")):
        assert best_name(score, 12345) == name
    for score in (0.0, 1e-7, -1.5e-300, 1e22, -(2.0**100), 1.0 / 3.0, np.float64(0.1)):
        assert best_score(Path(best_name(score, 7))) == score
    with pytest.raises(ValueError, match="finite"):
        best_name(float("nan"), 1)
    assert best_checkpoints(tmp_path) == []
    for name in ("best_-20.5_0000000007", "best_9.0_0000000003", "best_9.0_0000000004", "best_99_1", ".best_50.0_1"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    found = [each.name for each in best_checkpoints(tmp_path)]
    assert found == ["best_9.0_0000000004", "best_9.0_0000000003", "best_-20.5_0000000007"]


def test_three_highest_scores_are_kept(tmp_path: Path) -> None:
    best = [
        keep_if_best(checkpoint(tmp_path, version), score, version)
        for version, score in ((1, 5.0), (2, 9.0), (3, 1.0), (4, 7.0), (5, 0.5), (6, 10.0), (7, 9.0))
    ]
    assert best == [True, True, False, False, False, True, False]
    assert scored(tmp_path) == [(10.0, "6"), (9.0, "7"), (9.0, "2")]


def test_small_scores_are_compared_exactly(tmp_path: Path) -> None:
    best = [
        keep_if_best(checkpoint(tmp_path, version), score, version)
        for version, score in ((1, 0.001), (2, 0.002), (3, 0.003), (4, 0.02), (5, 0.04), (6, 0.03))
    ]
    assert best == [True, True, True, True, True, False]
    assert scored(tmp_path) == [(0.04, "5"), (0.03, "6"), (0.02, "4")]


def test_of_equal_scores_the_newest_are_kept(tmp_path: Path) -> None:
    for version in (1, 2, 3, 5, 4):
        assert keep_if_best(checkpoint(tmp_path, version), 500.0, version) == (version != 4)
    assert scored(tmp_path) == [(500.0, "5"), (500.0, "4"), (500.0, "3")]


def test_version_is_kept_only_once(tmp_path: Path) -> None:
    directory = checkpoint(tmp_path, 1)
    assert keep_if_best(directory, 5.0, 1)
    assert not keep_if_best(directory, 6.0, 1)
    assert scored(tmp_path) == [(5.0, "1")]


def test_rescoring_renames_the_checkpoint(tmp_path: Path) -> None:
    first, second = checkpoint(tmp_path, 1), checkpoint(tmp_path, 2)
    keep_if_best(first, 90.0, 1)
    (kept,) = best_checkpoints(tmp_path)
    assert rescore(kept, 50.0, 1).name == "best_50.0_0000000001"
    assert rescore(second, 60.0, 2).name == "best_60.0_0000000002"
    assert scored(tmp_path) == [(60.0, "2"), (50.0, "1")]
    assert second.exists()
    (best, _) = best_checkpoints(tmp_path)
    assert rescore(best, 60.0, 2) == best
    assert scored(tmp_path) == [(60.0, "2"), (50.0, "1")]


def test_newer_versions_than_that_of_a_resumed_run_are_no_longer_among_the_best(tmp_path: Path) -> None:
    keep_if_best(checkpoint(tmp_path, 5), 1.0, 5)
    keep_if_best(checkpoint(tmp_path, 7), 9.0, 7)
    (aside,) = set_aside_newer(tmp_path, 5)
    assert aside.name == "undone_best_9.0_0000000007"
    assert (aside / "content").read_text() == "7"
    assert [score for score, _ in scored(tmp_path)] == [1.0]
    assert keep_if_best(tmp_path / "checkpoints" / f"{7:010d}", 8.0, 7)  # the version that the run makes again
    assert set_aside_newer(tmp_path, 7) == []


def no_links(*_: Any) -> None:
    raise PermissionError(errno.EPERM, "Operation not permitted")


def full_disk(*_: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_checkpoint_is_copied_on_a_file_system_without_hard_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = checkpoint(tmp_path, 1)
    monkeypatch.setattr(os, "link", no_links)
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    assert keep_if_best(directory, 5.0, 1)
    assert len(synced) == len([*directory.iterdir()]) + 2  # its files and both directories
    assert rescore(best_checkpoints(tmp_path)[0], 6.0, 1).name == "best_6.0_0000000001"
    assert scored(tmp_path) == [(6.0, "1")]


@pytest.mark.parametrize("failing", ["os.fsync", "os.replace"])
def test_checkpoint_that_cannot_be_kept_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    directory = checkpoint(tmp_path, 1)
    monkeypatch.setattr(os, "link", no_links)
    monkeypatch.setattr(failing, full_disk)
    with pytest.raises(OSError, match="No space left on device") as error:
        keep_if_best(directory, 5.0, 1)
    assert error.value.strerror == "No space left on device"
    assert list(directory.parent.iterdir()) == [directory]


def test_leftovers_of_a_crash_are_replaced(tmp_path: Path) -> None:
    directory = checkpoint(tmp_path, 1)
    (directory.parent / ".best_5.0_0000000001" / "something").mkdir(parents=True)
    assert keep_if_best(directory, 5.0, 1)
    assert scored(tmp_path) == [(5.0, "1")]


@pytest.mark.parametrize(("agents", "named"), [((), ""), (("a",), "(a)"), (("a",) * 7, "(a, a, a, a, a, a, ...)")])
def test_an_evaluation_of_some_agents_of_a_game_says_who_plays_the_others(agents: tuple[str, ...], named: str) -> None:
    game = EnvironmentSpec(id="m:g", backend="pettingzoo", agents=agents)
    notes = evaluation_result(Path("1"), 1, game, np.ones(2), np.ones(2), ["cut"])["notes"]
    others = [f"all agents of the game but those of the policy {named} take random actions"] if agents else []
    assert notes == ["cut", *others]
