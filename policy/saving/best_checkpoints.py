"""The best checkpoints of a run: those with the highest scores, named by their score. Functions on directories."""

import math
import re
from pathlib import Path

from daedalus.policy.saving.sealed import link_sealed, remove_sealed

_BEST = re.compile(r"best_(-?\d+(?:\.\d+)?(?:e[+-]\d+)?)_(\d{10,})", re.ASCII)
_KEPT = 3  # scores over few episodes are noisy: with several, the best can be selected over more episodes


def best_name(score: float, policy_version: int) -> str:
    """Return the name of a checkpoint that is among the best, such as best_812.34_0000012345.

    The score in the name is exact, because checkpoints are compared by it. Raises ValueError for a score that is not
    finite.
    """
    if not math.isfinite(score):
        raise ValueError(f"the score must be finite, not {score}")
    return f"best_{float(score)!r}_{policy_version:010d}"


def is_best(directory: Path) -> bool:
    """Return whether a checkpoint has a name made by `best_name`."""
    return _BEST.fullmatch(directory.name) is not None


def best_score(directory: Path) -> float:
    """Return the score in a name made by `best_name`. Raises ValueError for another name."""
    return _score_and_version(directory)[0]


def best_checkpoints(run_directory: Path) -> list[Path]:
    """Return the checkpoints of a run that have a score, best first; of equal scores the newest first."""
    folder = run_directory / "checkpoints"
    scored = [entry for entry in folder.iterdir() if is_best(entry)] if folder.is_dir() else []
    return sorted(scored, key=_score_and_version, reverse=True)


def keep_if_best(checkpoint: Path, score: float, policy_version: int) -> bool:
    """Keep a checkpoint under its score if it is among the best and its version is not kept yet.

    Of equal scores the newest are kept, because they were trained longer. Removes the checkpoints that it displaces.
    Returns whether it is the best. Raises OSError if writing fails.
    """
    target = checkpoint.with_name(best_name(score, policy_version))
    kept = best_checkpoints(checkpoint.parent.parent)
    rank = sum(_score_and_version(other) > (score, policy_version) for other in kept)
    if rank >= _KEPT or any(_score_and_version(other)[1] == policy_version for other in kept):
        return False
    link_sealed(checkpoint, target)
    for other in kept[_KEPT - 1 :]:
        remove_sealed(other)
    return rank == 0


def set_aside_newer(run_directory: Path, policy_version: int) -> list[Path]:
    """Rename the checkpoints that have a score and a higher version than that from which a run continues.

    The run makes these versions again, with other weights. Returns the new paths. Raises OSError.
    """
    renamed = []
    for checkpoint in best_checkpoints(run_directory):
        if _score_and_version(checkpoint)[1] > policy_version:
            aside = checkpoint.with_name(f"undone_{checkpoint.name}")
            if aside.exists():
                remove_sealed(aside)
            renamed.append(checkpoint.rename(aside))
    return renamed


def rescore(checkpoint: Path, score: float, policy_version: int) -> Path:
    """Give a checkpoint another score and return its new path. Raises OSError if writing fails."""
    target = checkpoint.with_name(best_name(score, policy_version))
    if target != checkpoint:
        link_sealed(checkpoint, target)
        if is_best(checkpoint):
            remove_sealed(checkpoint)
    return target


def _score_and_version(directory: Path) -> tuple[float, int]:
    match = _BEST.fullmatch(directory.name)
    if match is None:
        raise ValueError(f"{directory} is not named like a best checkpoint")
    return float(match[1]), int(match[2])
