"""What evaluators play and how it went: the policy of each is kept as a checkpoint until it is reported on, the best
for good. State; no threads, no wire.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from daedalus.policy.saving.best_checkpoints import keep_if_best
from daedalus.protocol.messages import Acknowledgement, EvaluationReport

_MOST_PLAYING = 16


@dataclass(slots=True)
class Evaluations:
    """The evaluations of one run and one life of its learner."""

    learner_epoch: int
    playing: dict[str, tuple[Path, int, int]] = field(default_factory=dict)  # by evaluator: where, version, env_steps
    newest: dict[str, float] = field(default_factory=dict)  # as columns of learner/reporting/metrics.py, until taken

    @property
    def checkpoints_in_use(self) -> set[Path]:
        """The checkpoints that must not be pruned."""
        return {directory for directory, _, _ in self.playing.values()}

    def begin(self, evaluator: str, directory: Path, policy_version: int, env_steps: int) -> None:
        """An evaluator plays the policy that was saved in `directory`; what it played before is given up.

        Of more evaluators than a run has use for, those that asked first are given up: each holds a checkpoint.
        """
        self.playing.pop(evaluator, None)
        while len(self.playing) >= _MOST_PLAYING:
            del self.playing[next(iter(self.playing))]
        self.playing[evaluator] = directory, policy_version, env_steps

    def report(self, report: EvaluationReport) -> tuple[Acknowledgement, str]:
        """Takes in how a policy played: the answer to who played it, and what to tell the user."""
        if report.learner_epoch != self.learner_epoch:
            return Acknowledgement(verdict="fenced", reason="meant for another life of the learner"), ""
        directory, version, env_steps = self.playing.get(report.evaluator, (None, -1, 0))
        if directory is None or version != report.policy_version:
            reason = f"{report.evaluator!r} was not given version {report.policy_version} to play"
            return Acknowledgement(verdict="rejected", reason=reason), ""
        if not np.isfinite(report.returns).all():
            return Acknowledgement(verdict="rejected", reason="returns has a value that is not finite"), ""
        del self.playing[report.evaluator]
        mean, std = float(report.returns.mean(dtype=np.float64)), float(report.returns.std(dtype=np.float64))
        self.newest = {
            "evaluation_return_mean": mean,
            "evaluation_return_std": std,
            "evaluation_length_mean": float(report.lengths.mean()),
            "evaluation_env_steps": env_steps,
        }
        text = f"evaluation at {env_steps:,} env_steps: {mean:.1f} +- {std:.1f} over {len(report.returns)} episodes"
        try:
            text += ", the best so far" if keep_if_best(directory, mean, version) else ""
        except OSError as error:
            text += f"; among the best so far, but it could not be kept ({error.strerror})"
        return Acknowledgement(verdict="accepted"), text

    def take_newest(self) -> dict[str, float]:
        """The newest evaluation as metrics; empty if there was none since the last call."""
        newest, self.newest = self.newest, {}
        return newest
