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


def test_best_checkpoint_changes_only_with_a_higher_score_which_is_counted(run: Run) -> None:
    assert run.evaluations.counters.best_evaluation is None
    texts, counted = [], []
    for version, score in ((1, -5.0), (2, -20.5), (3, 9.0), (4, -1.0)):
        texts.append(run.play(version, score))
        counted.append(run.evaluations.counters.best_evaluation)
    assert [text.endswith("the best so far") for text in texts] == [True, False, True, False]
    assert counted == [-5.0, -5.0, 9.0, 9.0]
    assert [best_score(each) for each in best_checkpoints(run.directory)] == [9.0, -1.0, -5.0]
    assert best_checkpoints(run.directory)[0].name == "best_9.0_0000000003"


def test_best_checkpoint_is_kept_after_its_numbered_checkpoint_is_pruned_and_is_not_the_newest(run: Run) -> None:
    run.play(1, 5.0)
    for version in (2, 3, 4):
        run.save(version)
    assert run.names == ["0000000003", "0000000004", "best_5.0_0000000001"]
    best = best_checkpoints(run.directory)[0]
    assert load_checkpoint(best).policy.weights["w"].tolist() == [1.0] * 3
    assert [path.name for path in checkpoints(run.directory)] == ["0000000004", "0000000003"]
    assert load_newest(run.directory).policy.policy_version == 4


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


def report(
    version: int = 1, epoch: int = EPOCH, returns: tuple[float, ...] = (9.0,), length: int = 1
) -> EvaluationReport:
    played = np.array(returns, np.float32)
    lengths = np.full(len(played), length, np.int32)
    return EvaluationReport(evaluator="e", learner_epoch=epoch, policy_version=version, returns=played, lengths=lengths)


@pytest.mark.parametrize(
    ("wrong", "verdict", "reason"),
    [
        (report(version=2), "rejected", "evaluator 'e' has no evaluation of policy version 2"),
        (report(epoch=EPOCH + 1), "fenced", "another learner epoch"),
        *((report(returns=(3.0, value)), "rejected", "not finite") for value in (np.nan, np.inf, -np.inf)),
        (report(length=0), "rejected", "lengths has a value below 1"),
    ],
)
def test_wrong_report_is_not_accepted_and_the_evaluation_stays_open_for_one_right_one(
    run: Run, wrong: EvaluationReport, verdict: str, reason: str
) -> None:
    run.save(1)
    assert run.send(report())[0].verdict == "rejected", "no evaluation is in progress"
    run.begin(1)
    answer, text = run.send(wrong)
    assert (answer.verdict, text) == (verdict, "")
    assert reason in answer.reason
    assert best_checkpoints(run.directory) == []
    assert run.evaluations.take_newest() == {}
    assert [run.send(report())[0].verdict for _ in range(2)] == ["accepted", "rejected"]
    assert run.names[-1] == "best_9.0_0000000001"


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
