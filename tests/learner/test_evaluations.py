"""learner/serving/evaluations.py: checkpoints are kept during their evaluation, the best permanently."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from building import EPOCH, SPACES, run_spec

from daedalus.learner.reporting.metrics_rows import COLUMNS
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.evaluations import Evaluations
from daedalus.learner.training.checkpoint import encode_checkpoint, load_checkpoint, load_newest, save_checkpoint
from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_score
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.protocol.messages import Acknowledgement, EvaluationReport


class Run:
    """Run directory with the evaluations of one learner epoch."""

    def __init__(self, directory: Path, epoch: int = EPOCH) -> None:
        self.directory = directory
        self.evaluations, self._epoch = Evaluations(RunCounters(10)), epoch

    def save(self, version: int, keep: int = 2) -> Path:
        encoded = encode_checkpoint(
            spec=run_spec(),
            spaces=SPACES,
            policy_version=version,
            program=b"program",
            parameters={"w": np.full(3, version, np.float32)},
            state={},
            counters=RunCounters(1).state(0.0),
        )
        return save_checkpoint(self.directory, encoded, keep=keep, also_keep=self.evaluations.checkpoints_in_use)

    def begin(self, version: int, evaluator: str = "e") -> Path:
        directory = self.save(version)
        self.evaluations.begin(evaluator, directory, version, 1000 * version)
        return directory

    def report(
        self, version: int, *returns: float, evaluator: str = "e", epoch: int = EPOCH
    ) -> tuple[Acknowledgement, str]:
        return self.send(
            EvaluationReport(
                evaluator=evaluator,
                learner_epoch=epoch,
                policy_version=version,
                returns=np.array(returns, np.float32),
                lengths=np.arange(1, len(returns) + 1, dtype=np.int32),
            )
        )

    def send(self, report: EvaluationReport) -> tuple[Acknowledgement, str]:
        """Return the answer and the log message, after the checkpoint was kept if it is to be."""
        answer, evaluated = self.evaluations.report(report, self._epoch)
        return answer, evaluated.keep() if evaluated is not None else ""

    def play(self, version: int, *returns: float) -> str:
        """Run one evaluation from request to report, and return its log message."""
        self.begin(version)
        answer, text = self.report(version, *returns)
        assert answer.verdict == "accepted"
        return text

    @property
    def names(self) -> list[str]:
        return sorted(entry.name for entry in (self.directory / "checkpoints").iterdir())


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path)


# ------------------------------------------------------------------------------------------------- the best


def test_first_evaluated_checkpoint_is_kept_as_best_under_its_score(run: Run) -> None:
    assert run.play(7, 1.0, 2.0, 4.0) == "evaluation at 7,000 env_steps: 2.33 +- 1.25 over 3 episodes, the best so far"
    assert run.names == ["0000000007", "best_2.3333333333333335_0000000007"]
    best = best_checkpoints(run.directory)[0]
    assert read_policy(best).policy_version == 7
    assert load_checkpoint(best).policy.weights["w"].tolist() == [7.0] * 3


def test_best_checkpoint_changes_only_with_a_higher_score(run: Run) -> None:
    texts = [run.play(version, score) for version, score in ((1, 5.0), (2, 4.0), (3, 9.0), (4, -1.0))]
    assert [text.endswith("the best so far") for text in texts] == [True, False, True, False]
    assert [best_score(each) for each in best_checkpoints(run.directory)] == [9.0, 5.0, 4.0]
    assert best_checkpoints(run.directory)[0].name == "best_9.0_0000000003"


def test_negative_scores_are_compared_as_numbers(run: Run) -> None:
    for version, score in ((1, -20.5), (2, -3.0), (3, -10.0)):
        run.play(version, score)
    assert run.names[-1] == "best_-3.0_0000000002"


def test_best_checkpoint_is_kept_after_its_numbered_checkpoint_is_pruned(run: Run) -> None:
    run.play(1, 5.0)
    for version in (2, 3, 4):
        run.save(version)
    assert run.names == ["0000000003", "0000000004", "best_5.0_0000000001"]
    best = best_checkpoints(run.directory)[0]
    assert load_checkpoint(best).policy.weights["w"].tolist() == [1.0] * 3


def test_load_newest_ignores_best_checkpoints(run: Run) -> None:
    run.play(1, 5.0)
    run.save(2)
    assert [path.name for path in checkpoints(run.directory)] == ["0000000002", "0000000001"]
    assert load_newest(run.directory).policy.policy_version == 2


def test_resumed_run_compares_with_the_best_of_the_previous_process(run: Run) -> None:
    run.play(1, 5.0)
    resumed = Run(run.directory, EPOCH + 1)
    resumed.begin(2)
    answer, text = resumed.report(2, 4.0, epoch=EPOCH + 1)
    assert answer.verdict == "accepted"
    assert "best" not in text
    assert "best_5.0_0000000001" in run.names


@pytest.mark.parametrize("second", [5.0, 5.25, 4.75])
def test_version_that_two_evaluators_play_is_kept_once(run: Run, second: float) -> None:
    for evaluator in ("e", "f"):
        run.begin(1, evaluator)
    assert "the best so far" in run.report(1, 5.0)[1]
    answer, text = run.report(1, second, evaluator="f")
    assert answer.verdict == "accepted"
    assert "best" not in text
    assert run.names == ["0000000001", "best_5.0_0000000001"]


FULL = "No space left on device"


@pytest.mark.parametrize("arguments", [(errno.ENOSPC, FULL), (FULL,)], ids=["with a number", "without a number"])
def test_previous_best_is_kept_when_the_disk_is_full(
    run: Run, monkeypatch: pytest.MonkeyPatch, arguments: tuple[Any, ...]
) -> None:
    run.play(1, 5.0)
    run.begin(2)

    def refusing(*_: Any, **__: Any) -> None:
        raise OSError(*arguments)

    monkeypatch.setattr(os, "replace", refusing)
    answer, text = run.report(2, 9.0)
    monkeypatch.undo()
    assert answer.verdict == "accepted"
    assert text.endswith("the best so far, but its checkpoint was not kept: " + FULL)
    best = best_checkpoints(run.directory)[0]
    assert best.name == "best_5.0_0000000001"
    run.save(3)
    assert not [name for name in run.names if name.startswith(".")]  # unfinished files are removed
    assert "the best so far" in run.play(4, 9.0)
    assert run.names[-1] == "best_9.0_0000000004"


# -------------------------------------------------------------------------------------- checkpoints in use


def test_checkpoint_under_evaluation_is_not_pruned(run: Run) -> None:
    played = run.begin(1)
    for version in range(2, 7):
        run.save(version)
    assert run.names == ["0000000001", "0000000005", "0000000006"]
    assert read_policy(played).policy_version == 1
    run.report(1, 3.0)
    run.save(7)
    assert run.names == ["0000000006", "0000000007", "best_3.0_0000000001"]


def test_each_evaluator_reports_only_its_own_evaluation(run: Run) -> None:
    run.begin(1, "e")
    run.begin(2, "f")
    for version in range(3, 6):
        run.save(version)
    assert run.names[:2] == ["0000000001", "0000000002"]
    assert run.report(2, 1.0, evaluator="e")[0].verdict == "rejected"
    assert run.report(2, 1.0, evaluator="f")[0].verdict == "accepted"
    assert run.report(1, 1.0, evaluator="e")[0].verdict == "accepted"


def test_new_request_of_an_evaluator_replaces_its_previous_evaluation(run: Run) -> None:
    run.begin(1)
    run.begin(2)
    run.save(3)
    assert "0000000001" not in run.names
    assert run.report(1, 9.0)[0].verdict == "rejected"
    assert run.report(2, 3.0)[0].verdict == "accepted"


# ---------------------------------------------------------------------------------------- rejected reports


def assert_not_accepted(run: Run, answer: Acknowledgement, text: str, verdict: str, reason: str) -> None:
    assert answer.verdict == verdict
    assert reason in answer.reason
    assert text == ""
    assert best_checkpoints(run.directory) == []
    assert run.evaluations.take_newest() == {}


def test_report_without_an_evaluation_in_progress_is_rejected(run: Run) -> None:
    run.save(1)
    assert_not_accepted(run, *run.report(1, 9.0), "rejected", "evaluator 'e' has no evaluation of policy version 1")


def test_report_of_a_wrong_version_is_rejected_and_the_evaluation_stays_open(run: Run) -> None:
    run.begin(1)
    assert_not_accepted(run, *run.report(2, 9.0), "rejected", "no evaluation of policy version 2")
    assert run.report(1, 9.0)[0].verdict == "accepted"


def test_second_report_of_an_evaluation_is_rejected(run: Run) -> None:
    run.begin(1)
    assert run.report(1, 3.0)[0].verdict == "accepted"
    assert run.report(1, 9.0)[0].verdict == "rejected"
    assert run.names[-1] == "best_3.0_0000000001"


def test_report_for_another_learner_epoch_is_fenced(run: Run) -> None:
    run.begin(1)
    assert_not_accepted(run, *run.report(1, 9.0, epoch=EPOCH + 1), "fenced", "another learner epoch")
    assert run.report(1, 9.0)[0].verdict == "accepted"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_report_with_returns_that_are_not_finite_is_rejected(run: Run, value: float) -> None:
    run.begin(1)
    assert_not_accepted(run, *run.report(1, 3.0, value), "rejected", "not finite")
    assert run.report(1, 3.0)[0].verdict == "accepted"


def test_report_with_a_length_below_1_is_rejected(run: Run) -> None:
    run.begin(1)
    lengths = np.array([5, 0], np.int32)
    report = EvaluationReport(
        evaluator="e", learner_epoch=EPOCH, policy_version=1, returns=np.ones(2, np.float32), lengths=lengths
    )
    assert_not_accepted(run, *run.send(report), "rejected", "lengths has a value below 1")


# -------------------------------------------------------------------------------------------------- metrics


def test_newest_evaluation_is_returned_once_as_metrics_columns(run: Run) -> None:
    assert run.evaluations.take_newest() == {}
    run.play(1, 1.0)
    run.play(2, 3.0, 5.0)
    newest = run.evaluations.take_newest()
    assert newest == {
        "evaluation_return_mean": 4.0,
        "evaluation_return_std": 1.0,
        "evaluation_length_mean": 1.5,
        "evaluation_env_steps": 2000,
    }
    assert set(newest) <= set(COLUMNS)
    assert run.evaluations.take_newest() == {}


def test_mean_of_returns_does_not_overflow_float32(run: Run) -> None:
    run.play(1, 3e38, 3e38)
    assert run.evaluations.take_newest()["evaluation_return_mean"] == pytest.approx(3e38)


def test_number_of_checkpoints_in_use_is_bounded_when_evaluators_never_report(tmp_path: Path) -> None:
    evaluations = Evaluations(RunCounters(10))
    for number in range(100):
        evaluations.begin(f"evaluator-{number}", tmp_path / str(number), number, 0)
    assert evaluations.checkpoints_in_use == {tmp_path / str(number) for number in range(84, 100)}


def test_evaluations_of_one_owner_do_not_displace_the_others(tmp_path: Path) -> None:
    evaluations = Evaluations(RunCounters(10))
    evaluations.begin("honest", tmp_path / "honest", 0, 0)
    for number in range(100):
        evaluations.begin(f"greedy.{number}", tmp_path / str(number), number, 0)
    assert evaluations.checkpoints_in_use == {tmp_path / "honest", *(tmp_path / str(n) for n in range(85, 100))}


def test_best_evaluation_is_counted(run: Run) -> None:
    assert run.evaluations.counters.best_evaluation is None
    for version, mean, best in ((1, 4.0, 4.0), (2, 6.0, 6.0), (3, 2.0, 6.0)):
        run.play(version, mean, mean)
        assert run.evaluations.counters.best_evaluation == best
