"""Candidates for the best checkpoint of a finished run."""

import logging
from dataclasses import dataclass
from pathlib import Path

from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_score, is_best, rescore
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.policy.saving.sealed import DamagedError

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Candidate:
    """Undamaged checkpoint with its evaluation score. The newest checkpoint may have no score."""

    directory: Path
    policy_version: int
    score: float | None

    def rescore(self, score: float) -> None:
        """Store the checkpoint under a new score. Raises OSError on a disk error."""
        rescore(self.directory, score, self.policy_version)


def candidates(run_directory: Path) -> list[Candidate]:
    """Return the checkpoints with the best scores, and the newest checkpoint.

    Returns an empty list if the run was never evaluated. Logs a warning for each damaged checkpoint.
    """
    best = best_checkpoints(run_directory)
    found: dict[int, Candidate] = {}
    for directory in [*best, *checkpoints(run_directory)[:1]] if best else []:
        try:
            version = read_policy(directory).policy_version
        except DamagedError as error:
            _logger.warning("damaged checkpoint skipped: %s", error)
        else:
            found.setdefault(
                version, Candidate(directory, version, best_score(directory) if is_best(directory) else None)
            )
    return list(found.values())
