"""The best checkpoints of a run: those with the highest scores, named by their score. Functions on directories.

There are two kinds of scores, and they are never compared with each other. One is the mean return of an evaluation: of
episodes that this policy alone played. Where nobody evaluates, it is that of the newest episodes of training, which
slightly older policies played, perhaps with exploration and in another task.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, link_sealed, remove_sealed
from daedalus.protocol.spec import EnvironmentSpec
from daedalus.protocol.uploads import mean_return

_BEST = re.compile(r"best_(training_)?(-?\d+(?:\.\d+)?(?:e[+-]\d+)?)_(\d{10,})", re.ASCII)
_NAMED_AGENTS = 6  # of a game, for a person
_KEPT = 3  # of each kind. Scores over few episodes are noisy: with several, the best can be selected over more episodes


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingScore:
    """The mean return of the newest training episodes when a checkpoint was made."""

    return_mean: float
    episodes: int
    true_task: bool = True  # whether training plays the task of evaluations (RunSpec.trains_true_task)

    @property
    def of(self) -> str:
        """What the score is of."""
        other = (
            ""
            if self.true_task
            else ", of another task (environment.training_kwargs, environment.no_reward_limit or lessons)"
        )
        return f"the newest {self.episodes} training episodes{other}"

    def described(self) -> dict[str, Any]:
        """Return the score as JSON values, with what it is of."""
        return {"return_mean": self.return_mean, "episodes": self.episodes, "of": self.of}


def best_name(score: float, policy_version: int, *, training: bool = False) -> str:
    """Return the name of a checkpoint that is among the best, such as best_812.34_0000012345.

    The name has the exact score, because checkpoints are compared by it. That of a score of `training` episodes is such
    as best_training_812.34_0000012345. Raises ValueError for a score that is not finite.
    """
    if not math.isfinite(score):
        raise ValueError(f"the score must be finite, not {score}")
    return f"best_{'training_' if training else ''}{float(score)!r}_{policy_version:010d}"


def is_best(directory: Path) -> bool:
    """Return whether a checkpoint has a name made by `best_name`."""
    return _BEST.fullmatch(directory.name) is not None


def is_best_in_training(directory: Path) -> bool:
    """Return whether a checkpoint has a name made by `best_name` for a score of training episodes."""
    match = _BEST.fullmatch(directory.name)
    return match is not None and match[1] is not None


def best_score(directory: Path) -> float:
    """Return the score in a name made by `best_name`. Raises ValueError for another name."""
    return _score_and_version(directory)[0]


def best_checkpoints(run_directory: Path) -> list[Path]:
    """Return the checkpoints of a run that have an evaluation's score, best first; of equal scores the newest first."""
    return _named(run_directory, training=False)


def best_in_training(run_directory: Path) -> list[Path]:
    """Return the three best checkpoints of a run by their training episodes, as `best_checkpoints` does.

    They are those that were kept when they would have been pruned, and those that are not old enough for that.
    """
    folder = run_directory / "checkpoints"
    scored = {_score_and_version(each): each for each in _named(run_directory, training=True)}
    for entry in folder.iterdir() if folder.is_dir() else ():
        score = training_score(entry) if entry.name.isdigit() else None
        if score is not None:
            scored.setdefault((score, int(entry.name)), entry)
    return [scored[key] for key in sorted(scored, reverse=True)[:_KEPT]]


def training_score(checkpoint: Path) -> float | None:
    """Return the score of training episodes in the manifest of a checkpoint; None without one, or if it is damaged."""
    try:
        score = float(SealedDirectory(checkpoint).content["score"]["return_mean"])
    except (DamagedError, KeyError, TypeError, ValueError, OverflowError):
        return None
    return score if math.isfinite(score) else None


def newest_return(checkpoint: Path) -> float | None:
    """Return the mean return of the newest training episodes before a checkpoint; None if there were none."""
    try:
        returns = SealedDirectory(checkpoint).content["counters"]["returns"]
        mean = mean_return(returns) if returns else math.nan
    except (DamagedError, KeyError, TypeError, ValueError, OverflowError):
        return None
    return mean if math.isfinite(mean) else None


def _named(run_directory: Path, *, training: bool) -> list[Path]:
    folder = run_directory / "checkpoints"
    entries = folder.iterdir() if folder.is_dir() else ()
    scored = [entry for entry in entries if is_best(entry) and is_best_in_training(entry) == training]
    return sorted(scored, key=_score_and_version, reverse=True)


def keep_if_best(checkpoint: Path, score: float, policy_version: int, *, training: bool = False) -> bool:
    """Keep a checkpoint under its score if it is among the best of its kind and its version is not kept yet.

    Of equal scores the newest are kept, because they were trained longer. Removes the checkpoints that it displaces.
    Returns whether it is the best. Raises OSError if writing fails.
    """
    target = checkpoint.with_name(best_name(score, policy_version, training=training))
    kept = _named(checkpoint.parent.parent, training=training)
    rank = sum(_score_and_version(other) > (score, policy_version) for other in kept)
    if rank >= _KEPT or any(_score_and_version(other)[1] == policy_version for other in kept):
        return False
    link_sealed(checkpoint, target)
    for other in kept[_KEPT - 1 :]:
        remove_sealed(other)
    return rank == 0


def set_aside_newer(run_directory: Path, policy_version: int) -> list[Path]:
    """Rename the checkpoints that have a score and a higher version than that from which a run continues; -1: all.

    The run makes these versions again, with other weights, or it continues with other episodes, whose scores cannot be
    compared with these. Returns the new paths. Raises OSError.
    """
    renamed = []
    for checkpoint in [*best_checkpoints(run_directory), *_named(run_directory, training=True)]:
        if _score_and_version(checkpoint)[1] > policy_version:
            aside = checkpoint.with_name(f"undone_{checkpoint.name}")
            if aside.exists():
                remove_sealed(aside)
            renamed.append(checkpoint.rename(aside))
    return renamed


def rescore(checkpoint: Path, score: float, policy_version: int) -> Path:
    """Give a checkpoint another score, of an evaluation, and return its new path. Raises OSError if writing fails."""
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
    return float(match[2]), int(match[3])


def evaluation_result(
    checkpoint: Path,
    policy_version: int,
    environment: EnvironmentSpec,
    returns: np.ndarray,
    lengths: np.ndarray,
    notes: list[str],
) -> dict[str, Any]:
    """Return the result of an evaluation, as `daedalus evaluate --json` and summary.json name it.

    Args:
      checkpoint: that was evaluated.
      policy_version: its version.
      environment: that was played.
      returns, lengths: of the episodes, [K] each.
      notes: for a person, such as that episodes were cut.
    """
    if environment.is_game and environment.agents:
        named = ", ".join(environment.agents[:_NAMED_AGENTS]) + (", ..." if environment.agents[_NAMED_AGENTS:] else "")
        notes = [*notes, f"all agents of the game but those of the policy ({named}) take random actions"]
    return {
        "environment": environment.id,
        "backend": environment.backend,
        "checkpoint": str(checkpoint),
        "best_checkpoint": is_best(checkpoint),
        "policy_version": policy_version,
        "episodes": len(returns),
        "notes": notes,
        "return_mean": mean_return(returns),
        "return_std": float(returns.std()),
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "length_mean": float(lengths.mean()),
    }
