"""The best checkpoints of a run: a few that scored highest, each under its score. Names, links and renames on disk."""

import math
import os
import re
import shutil
from pathlib import Path

_BEST = re.compile(r"best_(-?\d+\.\d)_(\d{10,})", re.ASCII)
_KEPT = 3  # a score over few episodes flatters; more of them can be played where there is a choice


def best_name(score: float, policy_version: int) -> str:
    """What a checkpoint is called that evaluations found to be among the best: best_812.3_0000012345.

    Raises ValueError if the score is not finite.
    """
    if not math.isfinite(score):
        raise ValueError(f"a score must be finite, not {score}")
    return f"best_{score:.1f}_{policy_version:010d}"


def is_best(directory: Path) -> bool:
    """Whether a checkpoint bears a `best_name`."""
    return _BEST.fullmatch(directory.name) is not None


def best_score(directory: Path) -> float:
    """The score in a `best_name`, rounded as it stands there. Raises ValueError if the name is another."""
    return _score_and_version(directory)[0]


def best_checkpoints(run_directory: Path) -> list[Path]:
    """The checkpoints of a run that bear a score, the best first, of equals the newest."""
    folder = run_directory / "checkpoints"
    scored = [entry for entry in folder.iterdir() if is_best(entry)] if folder.is_dir() else []
    return sorted(scored, key=_score_and_version, reverse=True)


def keep_if_best(checkpoint: Path, score: float, policy_version: int) -> bool:
    """Keeps a checkpoint under its score if no version of it is, and it is among the best; whether it is the best.

    Those that it displaces go once it is there. Raises OSError if the disk refuses.
    """
    target = checkpoint.with_name(best_name(score, policy_version))
    kept = best_checkpoints(checkpoint.parent.parent)
    place = sum(_score_and_version(other)[0] >= best_score(target) for other in kept)
    if place >= _KEPT or any(_score_and_version(other)[1] == policy_version for other in kept):
        return False
    _link(checkpoint, target)
    for other in kept[_KEPT - 1 :]:
        shutil.rmtree(other, ignore_errors=True)
    return place == 0


def rescore(checkpoint: Path, score: float, policy_version: int) -> Path:
    """Gives a checkpoint another score; where it lies then. Raises OSError if the disk refuses."""
    target = checkpoint.with_name(best_name(score, policy_version))
    if target != checkpoint:
        _link(checkpoint, target)
        if is_best(checkpoint):
            shutil.rmtree(checkpoint, ignore_errors=True)
    return target


def _link(checkpoint: Path, target: Path) -> None:
    """The same files under another name, at once or not at all. Raises OSError if the disk refuses."""
    begun = target.with_name(f".{target.name}")
    shutil.rmtree(begun, ignore_errors=True)
    shutil.copytree(checkpoint, begun, copy_function=os.link)
    os.replace(begun, target)


def _score_and_version(directory: Path) -> tuple[float, int]:
    match = _BEST.fullmatch(directory.name)
    if match is None:
        raise ValueError(f"{directory} is not named like a best checkpoint")
    return float(match[1]), int(match[2])
