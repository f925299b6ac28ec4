"""learner/service.py with an actor and an evaluator in one process, over the memory transport."""

import csv
import io
import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from building import identity, make_rollout
from log_lines import LINES
from plain import vector_spaces
from processes import LIMIT, until

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.algorithms.sac import Sac
from daedalus.analysis.recorded_run import read_metrics
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.resuming import Beginning, CheckpointMismatchError, finished_run
from daedalus.learner.run.run_directory import read_json, write_json
from daedalus.learner.service import LearnerService, Outputs
from daedalus.learner.serving.events import read_events
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.training import replay_learner
from daedalus.learner.training.checkpoint import Checkpoint, load_newest
from daedalus.learner.training.learner import Learner
from daedalus.learner.training.replay_learner import ReplayLearner
from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_score, keep_if_best
from daedalus.policy.saving.saved_policy import SavedPolicy, checkpoints, read_policy
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Join, RunStatus, StatusReport
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

FAST = {"log_seconds": 0.05, "checkpoint_seconds": 1e6, "keep_checkpoints": 1}


class TrainingRun:
    """Learner, actor and evaluator of one run, each on its own thread."""

    def __init__(
        self,
        directory: Path,
        *,
        restored: Checkpoint | None = None,
        initial: SavedPolicy | None = None,
        other_spaces: bool = False,
        **sections: Any,
    ) -> None:
        self.directory = directory / "run"
        self.directory.mkdir(exist_ok=restored is not None)
        self._restored, self._initial, self._other_spaces = restored, initial, other_spaces
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
        self.network = MemoryNetwork()
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
        transport = MemoryTransport(self.network)
        progress = Progress(io.StringIO(), self.spec.training.env_steps)
        try:
            writers = [lambda: CsvWriter(self.directory / "metrics.csv")]
            context = RunContext.begin(self.directory, self.spec, self.stop, restored=self._restored)
            beginning = Beginning(
                restored=self._restored, initial=self._initial, allows_other_spaces=self._other_spaces
            )
            LearnerService(context, transport, Outputs(progress=progress, writers=writers), beginning).run()
        finally:
            transport.close()

    def play(self, role: Any, name: str, *arguments: Any) -> None:
        """Start another actor or evaluator."""
        self._threads.append(self._start(self._play, role, name, *arguments))

    def _play(self, role: Any, name: str, *arguments: Any) -> None:
        transport = MemoryTransport(self.network)
        try:
            role(ActorConfig(name=name, incarnation=1), transport, self.stop, *arguments).run()
        finally:
            transport.close()

    def end(self) -> None:
        """Stop the run, and wait for the threads."""
        self.stop.set()
        for thread in self._threads:
            thread.join(60.0)
            assert not thread.is_alive()
        for error in self._errors:
            raise error

    def finish(self) -> None:
        """Wait for the learner to use up its budget, then for the threads."""
        self._threads[0].join(LIMIT)
        self.end()

    def rows(self) -> list[dict[str, str]]:
        if not (self.directory / "metrics.csv").exists():
            return []
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
    assert max(float(row["evaluation_return_mean"]) for row in evaluated) <= best_score(best)
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
    assert summary["policy_lag_max"] <= training_run.spec.policy_lag_bound_with(0)


@pytest.mark.parametrize(
    ("algorithm", "exploration"), [("n_step_q", None), ("impala", (0.1,))], ids=["action values", "actor-critic"]
)
def test_a_run_whose_actors_explore_is_solved_by_an_evaluation(
    tmp_path: Path, algorithm: str, exploration: tuple[float, ...] | None
) -> None:
    """Its training episodes are too few to solve it."""
    training = {"env_steps": 10**9, "target_return": 1.0, "target_episodes": 10**6, "algorithm": algorithm}
    evaluation = {"seconds": 0.01, "episodes": 2}
    solved = TrainingRun(tmp_path, training={**training, "exploration": exploration}, evaluation=evaluation)
    solved.finish()
    assert json.loads((solved.directory / "summary.json").read_text())["solved"]
    finished = finished_run(solved.directory, solved.spec)
    assert finished is not None
    assert finished.reason.startswith("the target, mean return 1, was reached, and")
    assert not finished.missed


def test_a_run_without_exploration_is_not_solved_by_an_evaluation(tmp_path: Path) -> None:
    training = {"env_steps": 10**9, "target_return": 1.0, "target_episodes": 10**6, "algorithm": "impala"}
    training_run = TrainingRun(tmp_path, training=training, evaluation={"seconds": 0.01, "episodes": 2})
    try:
        until(lambda: sum("evaluation at" in line for line in LINES) >= 2)
    finally:
        training_run.end()
    assert not json.loads((training_run.directory / "summary.json").read_text())["solved"]


@pytest.mark.parametrize("algorithm", ["a2c", "a3c", "impala", "appo", "one_step_q", "one_step_sarsa", "n_step_q"])
def test_every_algorithm_trains_with_frame_stacks_and_recurrent_policy(tmp_path: Path, algorithm: str) -> None:
    training = {"env_steps": 10**9, "stop_when_solved": False, "algorithm": algorithm, **FEW_UPDATES}
    training_run = TrainingRun(tmp_path, training=training)
    try:
        until(lambda: any(row.get("policy_loss") for row in training_run.rows()))
    finally:
        training_run.end()
    last = training_run.rows()[-1]
    updates, versions = int(last["updates"]), read_policy(checkpoints(training_run.directory)[0]).policy_version
    assert updates == versions > 0
    assert updates % (4 if algorithm == "appo" else 1) == 0
    summary = json.loads((training_run.directory / "summary.json").read_text())
    assert "malformed" not in summary["rollouts_rejected"]


def test_a_replay_buffer_has_all_rollouts_that_were_accepted_before_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, kept, is_busy, goes_on = ReplayLearner.step, list[Rollout](), threading.Event(), threading.Event()

    def slow(learner: ReplayLearner, rollouts: Sequence[Rollout], progress: float) -> Any:
        kept.extend(rollouts)
        if len(kept) == 3:
            is_busy.set()
            goes_on.wait(LIMIT)
        return step(learner, rollouts, progress)

    monkeypatch.setattr(ReplayLearner, "step", slow)
    training_run = TrainingRun(
        tmp_path,
        environment={"id": "Pendulum-v1"},
        policy={"hidden": [8], "distribution": "squashed_gaussian", "state_dependent_std": True},
        collection={"actors": 1, "envs_per_actor": 1, "rollout_length": 4},
        training={"algorithm": "sac", "replay_transitions": 100, "minibatch_rows": 8, "env_steps": 10**9},
    )
    try:
        assert is_busy.wait(LIMIT)
        with closing(MemoryTransport(training_run.network)) as observer:

            def accepted() -> int:
                report = decode(observer.query(keys.status("run"), timeout=LIMIT)[0], Limits())
                assert isinstance(report, StatusReport)
                return report.status.rollouts_accepted

            until(lambda: accepted() == 5)  # two wait
        training_run.stop.set()
    finally:
        goes_on.set()
        training_run.end()
    assert len(kept) == read_json(training_run.directory / "summary.json")["rollouts_accepted"] >= 5


def test_a_run_ends_when_all_updates_of_its_budget_are_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gradients = Sac.gradients
    monkeypatch.setattr(Sac, "gradients", lambda *given, **named: time.sleep(0.01) or gradients(*given, **named))
    monkeypatch.setattr(replay_learner, "_SLICE_SECONDS", 0.005)  # one update, so that some are left
    training_run = TrainingRun(
        tmp_path,
        environment={"id": "Pendulum-v1"},
        policy={"hidden": [8], "distribution": "squashed_gaussian", "state_dependent_std": True},
        collection={"actors": 1, "envs_per_actor": 1, "rollout_length": 4},
        training={"algorithm": "sac", "minibatch_rows": 8, "env_steps": 12, "updates_per_env_step": 2.0},
    )
    training_run.finish()
    summary, (newest, *_) = read_json(training_run.directory / "summary.json"), checkpoints(training_run.directory)
    assert read_policy(newest).policy_version == summary["updates"] > 0


def test_what_is_known_of_a_batch_late_is_in_the_metrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Learner.step

    def late(learner: Learner, rollouts: Sequence[Rollout], progress: float) -> Any:
        learner.overlaps = True  # as on a GPU
        return step(learner, rollouts, progress)

    monkeypatch.setattr(Learner, "step", late)
    training_run = TrainingRun(tmp_path)
    try:
        until(lambda: len(training_run.rows()) > 3)
    finally:
        training_run.end()
    rows = [row for row in training_run.rows() if row["policy_loss"]]
    assert rows
    assert all(row["value_error_p50"] and row["explained_variance"] for row in rows)


def test_sender_of_rollouts_without_a_finite_gradient_is_quarantined_and_training_continues(tmp_path: Path) -> None:
    training_run = TrainingRun(
        tmp_path,
        environment={"id": "CartPole-v1"},
        policy={"hidden": [8], "activation": "relu"},
        training={"env_steps": 10**9, "stop_when_solved": False, "algorithm": "a3c"},
    )
    hostile = MemoryTransport(training_run.network)
    try:
        until(lambda: len(training_run.rows()) > 1)
        status = decode(hostile.query(keys.status("run"), timeout=LIMIT)[0], Limits())
        assert isinstance(status, StatusReport)
        spaces = vector_spaces(4, 2)
        join = Join(actor="hostile", incarnation=1, spaces=spaces, environments=1)
        hostile.query(keys.join("run", "hostile"), encode(join), timeout=LIMIT)
        answer, sequence = Acknowledgement(verdict="busy"), 0
        while answer.verdict != "quarantined":
            assert sequence < 10_000
            rollout = make_rollout(
                identity("hostile", sequence, epoch=status.status.learner_epoch),
                version=answer.policy_version,
                rows=8,
                environments=1,
                frames=np.full((9, 1, 4), 1e15, np.float32),
                actions=np.zeros((8, 1), np.uint8),
            )
            (data,) = hostile.query(keys.rollouts("run", "hostile"), encode(rollout), timeout=LIMIT)
            message = decode(data, Limits())
            assert isinstance(message, Acknowledgement)
            answer, sequence = message, sequence + 1
        assert "of its rollouts had no finite gradient" in answer.reason
        rows = len(training_run.rows())
        until(lambda: len(training_run.rows()) > rows + 1 and training_run.rows()[-1]["policy_loss"])
    finally:
        training_run.end()
    assert "a rollout of actor 'hostile' has no finite gradient, and was left out" in LINES
    summary = json.loads((training_run.directory / "summary.json").read_text())
    assert summary["updates_skipped"] == summary["rollouts_rejected"]["non_finite"] >= 3
    weights = read_policy(checkpoints(training_run.directory)[0]).weights
    assert all(np.isfinite(array).all() for array in weights.values())


class HangingCollector(EnvironmentCollector):
    """Collector whose environment can be made to hang, as a broken simulator does."""

    def __init__(self, responds: threading.Event) -> None:
        super().__init__()
        self._responds = responds

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout:
        assert self._responds.wait(LIMIT)
        return super().collect(identity, on_row)


def test_actor_whose_environment_hangs_does_not_hold_the_updates_of_a2c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daedalus.learner.serving.rollout_buffer._PATIENCE_SECONDS", 0.5)
    training_run = TrainingRun(
        tmp_path,
        environment={"id": "CartPole-v1"},
        collection={"actors": 2, "envs_per_actor": 1, "rollout_length": 8},
        training={"env_steps": 10**9, "stop_when_solved": False, "algorithm": "a2c"},
    )
    responds = threading.Event()
    responds.set()
    training_run.play(ActorService, "b", HangingCollector(responds))
    observer = MemoryTransport(training_run.network)

    def env_steps(name: str) -> int:
        return {actor.actor: actor.env_steps for actor in status().actors}.get(name, 0)

    def status() -> RunStatus:
        report = decode(observer.query(keys.status("run"), timeout=LIMIT)[0], Limits())
        assert isinstance(report, StatusReport)
        return report.status

    try:
        until(training_run.rows)
        until(lambda: env_steps("b"))
        responds.clear()
        until(
            lambda: (
                status().problems == ("batches do not wait for b: connected, but far slower than the others, or hung",)
            )
        )
        before = env_steps("a")
        until(lambda: env_steps("a") > before)
        before = env_steps("b")
        responds.set()
        until(lambda: env_steps("b") > before)
        until(lambda: not status().problems)
    finally:
        responds.set()
        training_run.end()
    assert any(line.startswith("batches no longer wait for actor 'b'") for line in LINES)


EXPLORATION = "exploration.annealing"  # the parameter


class RecordedSteps:
    """The progress and the env_steps of every batch that learners train on, and how much actors explored before it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, pause_after: int = 0) -> None:
        self.progress: list[float] = []
        self.env_steps: list[int] = []
        self.exploration: list[float] = []
        self.paused, self.go_on = threading.Event(), threading.Event()
        step = Learner.step

        def recorded(learner: Learner, rollouts: Sequence[Rollout], progress: float) -> Any:
            self.progress.append(progress)
            self.exploration += [float(learner.weights().get(EXPLORATION, np.zeros(1)).item())]
            self.env_steps.append(sum(int(rollout.valid.sum()) for rollout in rollouts))
            if len(self.progress) == pause_after:
                self.paused.set()
                assert self.go_on.wait(LIMIT)
            return step(learner, rollouts, progress)

        monkeypatch.setattr(Learner, "step", recorded)

    def stop(self, training_run: TrainingRun) -> None:
        """Stop the run after the batch at which this object pauses."""
        assert self.paused.wait(LIMIT)
        training_run.stop.set()
        self.go_on.set()
        training_run.end()


def annealed(budget: int) -> dict[str, Any]:
    return {
        "training": {"env_steps": budget, "algorithm": "a3c", "learning_rate": 0.01, "learning_rate_final": 0.001},
        "environment": {"id": "CartPole-v1"},
        "policy": {"hidden": [8]},
    }


def test_batch_is_trained_with_the_progress_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = RecordedSteps(monkeypatch)
    training_run = TrainingRun(tmp_path, **annealed(600))
    training_run.finish()
    before = np.cumsum([0, *steps.env_steps])
    assert before[-1] >= 600 > before[-2]
    np.testing.assert_allclose(steps.progress, before[:-1] / 600)


def test_resuming_with_a_larger_budget_continues_the_annealing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = RecordedSteps(monkeypatch, pause_after=10)
    training_run = TrainingRun(tmp_path, **annealed(2000))
    steps.stop(training_run)
    first, done = len(steps.progress), sum(steps.env_steps)
    checkpoint = load_newest(training_run.directory)
    assert checkpoint.counters["env_steps"] == done < 2000
    resumed = TrainingRun(tmp_path, restored=checkpoint, **annealed(4000))
    resumed.finish()
    assert steps.progress[first] == pytest.approx(done / 2000)
    assert steps.progress == sorted(steps.progress)  # a rate that falls never rises
    expected = done / 2000 + (1 - done / 2000) * (np.cumsum(steps.env_steps)[first:-1] - done) / (4000 - done)
    np.testing.assert_allclose(steps.progress[first + 1 :], expected)
    rates = [float(row["learning_rate"]) for row in resumed.rows()]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] == pytest.approx(0.001)


@pytest.mark.parametrize("other", [1000, 4000])
def test_resuming_with_another_budget_does_not_change_the_env_steps_of_the_exploration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: int
) -> None:
    exploring = {"algorithm": "n_step_q", "exploration_env_steps": 800}
    first, second = annealed(2000), annealed(other)
    for settings in (first, second):
        settings["training"] |= exploring
    steps = RecordedSteps(monkeypatch, pause_after=5)
    steps.stop(TrainingRun(tmp_path, **first))
    TrainingRun(tmp_path, restored=load_newest(tmp_path / "run"), **second).finish()
    before = np.cumsum([0, *steps.env_steps])[:-2]  # of the batch before
    expected = [1.0, *np.maximum(1.0 - before / 800, 0.0)]
    np.testing.assert_allclose(steps.exploration, expected, atol=2**-8)  # of bfloat16
    assert before[-1] > 800


def test_resuming_with_the_same_budget_anneals_as_without_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = RecordedSteps(monkeypatch, pause_after=10)
    training_run = TrainingRun(tmp_path, **annealed(2000))
    steps.stop(training_run)
    TrainingRun(tmp_path, restored=load_newest(training_run.directory), **annealed(2000)).finish()
    np.testing.assert_array_equal(steps.progress, np.cumsum([0, *steps.env_steps])[:-1] / 2000)


def test_a_resumed_run_undoes_what_came_after_its_checkpoint(tmp_path: Path) -> None:
    """As if the learner had trained on to 5,000 env_steps, and was killed before its next checkpoint."""
    TrainingRun(tmp_path, **annealed(300)).finish()
    run, checkpoint = tmp_path / "run", load_newest(tmp_path / "run")
    env_steps = checkpoint.counters["env_steps"]
    with closing(CsvWriter(run / "metrics.csv")) as writer:
        row = {"wall_seconds": 900.0, "env_steps": 4000, "evaluation_return_mean": 7.0, "user/score": 1.0}
        writer.write({**row, "evaluation_env_steps": env_steps - 1}, Details())
        writer.write({**row, "env_steps": 5000, "evaluation_env_steps": 4500}, Details())
    keep_if_best(checkpoint.policy.directory, 400.0, 10**9)
    keep_if_best(checkpoint.policy.directory, 40.0, 1)
    write_json(run / "summary.json", {"env_steps": 5000, "finished": True})
    write_json(run / "evaluation.json", {"policy_version": 10**9})
    TrainingRun(tmp_path, restored=checkpoint, **annealed(600)).finish()
    metrics = read_metrics(run)
    assert metrics["env_steps"][-1] == read_json(run / "summary.json")["env_steps"] < 1000
    assert (np.diff(metrics["env_steps"]) >= 0).all()
    assert (np.diff(metrics["wall_seconds"]) >= 0).all()
    known = ~np.isnan(metrics["evaluation_return_mean"])
    assert 4500 not in metrics["evaluation_env_steps"]
    assert metrics["evaluation_env_steps"][known][0] in (env_steps - 1, *metrics["env_steps"])
    scores = [best_score(each) for each in best_checkpoints(run)]
    assert 40.0 in scores
    assert 400.0 not in scores
    assert not (run / "evaluation.json").exists()
    (event,) = [event for event in read_events(run) if event.text.startswith("resumed: ")]
    assert "undone are 2 rows of metrics.csv" in event.text


def test_returns_of_episodes_with_another_limit_say_nothing_after_a_resume(tmp_path: Path) -> None:
    TrainingRun(tmp_path, **annealed(300)).finish()
    run, checkpoint = tmp_path / "run", load_newest(tmp_path / "run")
    keep_if_best(checkpoint.policy.directory, 400.0, 1)
    settings = annealed(600)
    settings["environment"]["max_episode_steps"] = 5
    TrainingRun(tmp_path, restored=checkpoint, **settings).finish()
    assert all(best_score(each) <= 5.0 for each in best_checkpoints(run))
    assert read_json(run / "summary.json")["episode_return_mean"] <= 5.0
    (event,) = [event for event in read_events(run) if event.text.startswith("resumed: ")]
    assert "undone_best_400.0_0000000001, whose policy is kept" in event.text


def test_resuming_with_a_learning_rate_of_0_is_reported(tmp_path: Path) -> None:
    settings = annealed(100)
    settings["training"]["learning_rate_final"] = 0.0
    TrainingRun(tmp_path, **settings).finish()
    settings["training"] |= {"env_steps": 200, "learning_rate": 0.5, "entropy_bonus": 0.5}  # which has no final value
    TrainingRun(tmp_path, restored=load_newest(tmp_path / "run"), **settings).finish()
    assert sum("the learning rate has been annealed to 0" in line for line in LINES) == 1
    assert sum("no effect: training.learning_rate; the budget from before" in line for line in LINES) == 1


def budget(env_steps: int) -> dict[str, Any]:
    training = {"env_steps": env_steps, "stop_when_solved": False, "algorithm": "appo", **FEW_UPDATES}
    return {"training": training, "service": {**FAST, "keep_checkpoints": 99}}


def test_resumed_run_remembers_when_it_reached_its_target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def train(env_steps: int, restored: Checkpoint | None = None) -> dict[str, Any]:
        settings = budget(env_steps)
        settings["training"] |= {"target_return": 1.0, "target_episodes": 1}
        TrainingRun(tmp_path, restored=restored, **settings).finish()
        return json.loads((tmp_path / "run" / "summary.json").read_text())

    before = train(400)
    assert before["solved"]
    monkeypatch.setattr(RunCounters, "is_solved", lambda *_: False)  # the newest episodes are worse than the target now
    after = train(500, load_newest(tmp_path / "run"))
    assert after["env_steps"] > before["env_steps"]
    assert (after["solved"], after["seconds_to_target"]) == (True, before["seconds_to_target"])


def test_the_restored_state_is_exact(tmp_path: Path) -> None:
    """Nothing is left to train: the state that was loaded is saved again, and the row has no rates."""
    TrainingRun(tmp_path, **budget(200)).finish()
    (before,) = checkpoints(tmp_path / "run")[:1]
    files = {name: (before / name).read_bytes() for name in ("learner.safetensors", "parameters.safetensors")}
    again = TrainingRun(tmp_path, restored=load_newest(tmp_path / "run"), **budget(200))
    again.finish()
    assert checkpoints(tmp_path / "run")[0] == before
    assert {name: (before / name).read_bytes() for name in files} == files
    rates = ("env_steps_per_second", "updates_per_second", "policy_lag_mean")
    assert [again.rows()[-1][name] for name in rates] == ["", "", ""]


def test_a_run_begins_with_the_weights_of_another(tmp_path: Path) -> None:
    """They are in its first checkpoint, so that a learner which is killed early continues from them."""
    (tmp_path / "first").mkdir()
    first = TrainingRun(tmp_path / "first", **budget(200))
    first.finish()
    initial = read_policy(checkpoints(first.directory)[0])
    second = TrainingRun(tmp_path, initial=initial, **budget(300))
    second.finish()
    newest, *_, oldest = [read_policy(each) for each in checkpoints(second.directory)]
    assert (oldest.policy_version, newest.policy_version > 0) == (0, True)
    for name, array in initial.weights.items():
        np.testing.assert_array_equal(oldest.weights[name], array)
    assert any((newest.weights[name] != array).any() for name, array in initial.weights.items())
    assert any(f"initial weights: policy version {initial.policy_version} of" in line for line in LINES)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    (tmp_path / "first").mkdir()
    first = TrainingRun(tmp_path / "first", **budget(100), policy={"hidden": [8]})
    first.finish()
    initial = read_policy(checkpoints(first.directory)[0])
    with pytest.raises(CheckpointMismatchError) as refused:
        TrainingRun(tmp_path, initial=initial, **budget(100), policy={"hidden": [9]}).finish()
    assert str(refused.value) == (
        f"--init-from {initial.directory}: the weights 'encoder.layers.0.weight' are (8, 8) in the checkpoint and "
        "(9, 8) in this run's network: use the same environment and [policy] settings"
    )


def test_weights_that_only_fit_by_their_shapes_are_refused_unless_that_is_allowed(tmp_path: Path) -> None:
    (tmp_path / "first").mkdir()
    first = TrainingRun(tmp_path / "first", **budget(100))
    first.finish()
    initial = read_policy(checkpoints(first.directory)[0])
    space = initial.spaces.observations["observation"]
    other = replace(initial, spaces=initial.spaces.model_copy(update={"observations": {"lidar": space}}))
    for folder in ("refused", "allowed"):
        (tmp_path / folder).mkdir()
    with pytest.raises(CheckpointMismatchError, match=r"^--init-from .*: its policy is for other spaces: ob"):
        TrainingRun(tmp_path / "refused", initial=other, **budget(100)).finish()
    TrainingRun(tmp_path / "allowed", initial=other, other_spaces=True, **budget(100)).finish()
    assert any("initial weights of other spaces" in line for line in LINES)
    with pytest.raises(CheckpointMismatchError, match=r"policy\.activation is tanh there, and relu here"):
        TrainingRun(
            tmp_path / "first",
            restored=load_newest(first.directory),
            **budget(200),
            policy={"hidden": [8], "memory": "gru", "memory_units": 4, "activation": "relu"},
        ).finish()
