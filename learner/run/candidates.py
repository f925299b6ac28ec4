"""Candidates for the best checkpoint of a finished run."""

import logging
from dataclasses import dataclass
from pathlib import Path

from daedalus.policy.saving.best_checkpoints import (
    best_checkpoints,
    best_in_training,
    best_score,
    is_best,
    is_best_in_training,
    rescore,
)
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.policy.saving.sealed import DamagedError

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Candidate:
    """Undamaged checkpoint with its score so far. The newest checkpoint may have no score."""

    directory: Path
    policy_version: int
    score: float | None
    of_training: bool = False  # whether the score is of training episodes, and not of an evaluation

    def rescore(self, score: float) -> None:
        """Store the checkpoint under a new score. Raises OSError on a disk error."""
        rescore(self.directory, score, self.policy_version)


def candidates(run_directory: Path) -> list[Candidate]:
    """Return the checkpoints with the best scores of evaluations and of training episodes, and the newest checkpoint.

    Returns an empty list if no checkpoint has a score, and if nobody evaluated and the newest was the best in training:
    there is nothing to select. Logs a warning for each damaged checkpoint.
    """
    evaluated, trained = best_checkpoints(run_directory), best_in_training(run_directory)
    newest = checkpoints(run_directory)[:1]
    if not evaluated and trained[:1] == newest:
        return []
    best = [*evaluated, *trained]
    found: dict[int, Candidate] = {}
    for directory in [*best, *newest] if best else []:
        try:
            version = read_policy(directory).policy_version
        except DamagedError as error:
            _logger.warning("damaged checkpoint skipped: %s", error)
        else:
            score = best_score(directory) if is_best(directory) else None
            found.setdefault(version, Candidate(directory, version, score, is_best_in_training(directory)))
    return list(found.values())
