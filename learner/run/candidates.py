"""Which checkpoints of a run may be its best, once it is over."""

import logging
from dataclasses import dataclass
from pathlib import Path

from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_score, is_best, rescore
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.policy.saving.sealed import DamagedError

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A checkpoint that is whole, and what evaluations gave it; the newest may have none."""

    directory: Path
    policy_version: int
    score: float | None

    def rescore(self, score: float) -> None:
        """Keeps it under another score. Raises OSError if the disk refuses."""
        rescore(self.directory, score, self.policy_version)


def candidates(run_directory: Path) -> list[Candidate]:
    """Those that scored highest, and the newest if it is none of them. Of a run that was never evaluated: none."""
    best = best_checkpoints(run_directory)
    found: dict[int, Candidate] = {}
    for directory in [*best, *checkpoints(run_directory)[:1]] if best else []:
        try:
            version = read_policy(directory).policy_version
        except DamagedError as error:
            _logger.warning("passed over: %s", error)
        else:
            found.setdefault(
                version, Candidate(directory, version, best_score(directory) if is_best(directory) else None)
            )
    return list(found.values())
