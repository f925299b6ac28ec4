"""Evaluations in progress and their results. State; no threads, no network.

The checkpoint of a policy is kept while an evaluator plays the policy. The best checkpoints are kept permanently.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from daedalus.learner.run.counters import RunCounters
from daedalus.policy.saving.best_checkpoints import keep_if_best
from daedalus.protocol import keys
from daedalus.protocol.messages import Acknowledgement, EvaluationReport
from daedalus.protocol.texts import short_number
from daedalus.protocol.uploads import LARGEST_EPISODE_NUMBER, mean_return

_MAX_IN_PROGRESS = 16


@dataclass(frozen=True, slots=True)
class Evaluated:
    """Result of an evaluation that was accepted."""

    directory: Path  # of the checkpoint
    policy_version: int
    mean: float
    text: str  # a log message

    def keep(self) -> str:
        """Keep the checkpoint if it is among the best, and return the log message with what came of that."""
        try:
            best = keep_if_best(self.directory, self.mean, self.policy_version)
        except OSError as error:
            return f"{self.text}, the best so far, but its checkpoint was not kept: {error.strerror or error}"
        return self.text + (", the best so far" if best else "")


@dataclass(slots=True)
class Evaluations:
    """Evaluations of one run during one learner epoch."""

    counters: RunCounters
    # By evaluator: checkpoint directory, policy version, env_steps.
    in_progress: dict[str, tuple[Path, int, int]] = field(default_factory=dict)
    heard: float = -math.inf  # when an evaluator last asked or reported, on the monotonic clock
    newest: dict[str, float] = field(default_factory=dict)  # columns of learner/reporting/metrics_rows.py, until taken

    @property
    def checkpoints_in_use(self) -> set[Path]:
        """Directories of the checkpoints that must not be pruned."""
        return {directory for directory, _, _ in self.in_progress.values()}

    def carry_over(self, undone: Sequence[Mapping[str, float]]) -> None:
        """Keep, from rows that a resumed run undoes, the newest evaluation of a policy up to its checkpoint."""
        for row in undone:
            if row.get("evaluation_env_steps", np.inf) <= self.counters.env_steps:
                self.newest = {name: value for name, value in row.items() if name.startswith("evaluation_")}

    def begin(self, evaluator: str, directory: Path, policy_version: int, env_steps: int) -> None:
        """Start the evaluation of the policy in `directory`; it replaces the evaluator's previous evaluation.

        At capacity, drop the oldest evaluation of the owner with the most, because each may keep a checkpoint on disk.
        """
        self.in_progress.pop(evaluator, None)
        while len(self.in_progress) >= _MAX_IN_PROGRESS:
            del self.in_progress[keys.first_of_largest_owner(self.in_progress)]
        self.in_progress[evaluator] = directory, policy_version, env_steps

    def report(self, report: EvaluationReport, learner_epoch: int) -> tuple[Acknowledgement, Evaluated | None]:
        """Record an evaluation. Return the answer to the evaluator, and the result if the report is accepted.

        `learner_epoch` is that of this process: an evaluation of a policy of another one is fenced.
        """
        if report.learner_epoch != learner_epoch:
            return Acknowledgement(verdict="fenced", reason="the report is for another learner epoch"), None
        directory, version, env_steps = self.in_progress.get(report.evaluator, (None, -1, 0))
        if directory is None or version != report.policy_version:
            reason = f"evaluator {report.evaluator!r} has no evaluation of policy version {report.policy_version}"
            return Acknowledgement(verdict="rejected", reason=reason), None
        if not (np.abs(report.returns) <= LARGEST_EPISODE_NUMBER).all():
            reason = "returns has a value that is not finite, or too large"
            return Acknowledgement(verdict="rejected", reason=reason), None
        if (report.lengths < 1).any():
            return Acknowledgement(verdict="rejected", reason="lengths has a value below 1"), None
        del self.in_progress[report.evaluator]
        mean = mean_return(report.returns)
        self.counters.evaluated(mean)
        text = f"evaluation at {env_steps:,} env_steps: {self.note(report, env_steps)}"
        return Acknowledgement(verdict="accepted"), Evaluated(directory, version, mean, text)

    def note(self, report: EvaluationReport, env_steps: int) -> str:
        """Let a report be the newest evaluation in the metrics, and return its result in words."""
        mean, std = mean_return(report.returns), float(report.returns.std(dtype=np.float64))
        self.newest = {
            "evaluation_return_mean": mean,
            "evaluation_return_std": std,
            "evaluation_length_mean": float(report.lengths.mean()),
            "evaluation_env_steps": env_steps,
        }
        return f"{short_number(mean)} +- {short_number(std)} over {len(report.returns)} episodes"

    def take_newest(self) -> dict[str, float]:
        """Return the newest evaluation as metrics; empty without an evaluation since the last call."""
        newest, self.newest = self.newest, {}
        return newest
