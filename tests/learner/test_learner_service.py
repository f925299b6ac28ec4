"""learner/service.py with an actor and an evaluator in one process, over the memory transport."""

import csv
import io
import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from log_lines import LINES
from processes import until

from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.service import ActorConfig, ActorService
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.service import LearnerService
from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_score
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.protocol.spec import RunSpec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

FAST = {"log_seconds": 0.05, "checkpoint_seconds": 1e6, "keep_checkpoints": 1}


class TrainingRun:
    """Learner, actor and evaluator of one run, each on its own thread."""

    def __init__(self, directory: Path, **sections: Any) -> None:
        self.directory = directory / "run"
        self.directory.mkdir()
        self.spec = RunSpec.model_validate(
            {
                "environment": {"id": "CartPole-v1", "frame_stack": 2},
                "policy": {"hidden": [8], "memory": "gru", "memory_units": 4},
                "collection": {"actors": 1, "envs_per_actor": 4, "rollout_length": 8},
                "training": {"env_steps": 10**9, "stop_when_solved": False, "algorithm": "appo", **FEW_UPDATES},
                "service": FAST,
                **sections,
            }
        )
        self.stop = threading.Event()
        self._network = MemoryNetwork()
        self._errors: list[BaseException] = []
        self._threads = [
            self._start(self._learn),
            self._start(self._play, ActorService, "a"),
            self._start(self._play, Evaluator, "e"),
        ]

    def _start(self, work: Any, *arguments: Any) -> threading.Thread:
        thread = threading.Thread(target=self._watch, args=(work, *arguments), daemon=True)
        thread.start()
        return thread

    def _watch(self, work: Any, *arguments: Any) -> None:
        try:
            work(*arguments)
        except BaseException as error:
            self._errors.append(error)

    def _learn(self) -> None:
        transport = MemoryTransport(self._network)
        progress = Progress(io.StringIO(), self.spec.training.env_steps)
        try:
            writers = [lambda: CsvWriter(self.directory / "metrics.csv")]
            LearnerService(
                self.spec, self.directory, transport, self.stop, progress, writers, started=time.monotonic()
            ).run()
        finally:
            transport.close()

    def _play(self, role: Any, name: str) -> None:
        transport = MemoryTransport(self._network)
        try:
            role(ActorConfig(name=name, incarnation=1), transport, self.stop).run()
        finally:
            transport.close()

    def end(self) -> None:
        self.stop.set()
        for thread in self._threads:
            thread.join(60.0)
            assert not thread.is_alive()
        assert not self._errors

    def rows(self) -> list[dict[str, str]]:
        with open(self.directory / "metrics.csv", newline="") as file:
            return list(csv.DictReader(file))


FEW_UPDATES = {"passes": 2, "minibatches": 2}


def test_evaluations_are_in_the_metrics_and_the_best_policy_is_kept(tmp_path: Path) -> None:
    training_run = TrainingRun(tmp_path, evaluation={"seconds": 0.01, "episodes": 3})
    try:
        until(lambda: sum("evaluation at" in line for line in LINES) >= 3)
    finally:
        training_run.end()
    best = best_checkpoints(training_run.directory)[0]
    assert read_policy(best).policy_version % 4 == 0  # passes x minibatches
    evaluated = [row for row in training_run.rows() if row["evaluation_return_mean"]]
    assert evaluated
    # A row contains only the newest evaluation, so the best evaluation may be missing.
    assert max(float(row["evaluation_return_mean"]) for row in evaluated) <= best_score(best) + 0.05
    assert all(int(row["evaluation_env_steps"]) <= int(row["env_steps"]) for row in evaluated)
    # Checkpoints under evaluation are kept, and pruned at the end of the run.
    assert len(checkpoints(training_run.directory)) <= 2


def test_checkpoint_under_evaluation_is_not_pruned_by_later_checkpoints(tmp_path: Path) -> None:
    """The learner saves after every update and keeps one checkpoint, while an older one is evaluated."""
    often = {**FAST, "checkpoint_seconds": 1e-6}
    training_run = TrainingRun(tmp_path, evaluation={"seconds": 0.01, "episodes": 400}, service=often)
    try:
        until(lambda: "\n".join(LINES).count("evaluation at") >= 2)
    finally:
        training_run.end()
    assert "the best so far" in "\n".join(LINES)
    assert "was not kept" not in "\n".join(LINES)


def test_evaluator_is_not_counted_as_an_actor(tmp_path: Path) -> None:
    training_run = TrainingRun(tmp_path, evaluation={"seconds": 0.01, "episodes": 3})
    try:
        until(lambda: "evaluation at" in "\n".join(LINES))
    finally:
        training_run.end()
    assert {row["actors"] for row in training_run.rows()} <= {"0", "1"}
    summary = json.loads((training_run.directory / "summary.json").read_text())
    assert summary["policy_lag_max"] <= training_run.spec.training.policy_lag_bound


@pytest.mark.parametrize("algorithm", ["a2c", "a3c", "impala", "appo"])
def test_every_algorithm_trains_with_frame_stacks_and_recurrent_policy(tmp_path: Path, algorithm: str) -> None:
    training = {"env_steps": 10**9, "stop_when_solved": False, "algorithm": algorithm, **FEW_UPDATES}
    training_run = TrainingRun(tmp_path, training=training)
    try:
        until(
            lambda: (
                (training_run.directory / "metrics.csv").exists()
                and any(row.get("policy_loss") for row in training_run.rows())
            )
        )
    finally:
        training_run.end()
    last = training_run.rows()[-1]
    updates, versions = int(last["updates"]), read_policy(checkpoints(training_run.directory)[0]).policy_version
    assert updates == versions > 0
    assert updates % (4 if algorithm == "appo" else 1) == 0
    summary = json.loads((training_run.directory / "summary.json").read_text())
    assert "malformed" not in summary["rollouts_rejected"]
