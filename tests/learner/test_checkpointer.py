"""learner/training/checkpointer.py: checkpoints are written beside training, and the best of them are kept."""

import os
import resource
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from building import POLICY, SPACES, make_rollouts, run_context, run_spec
from log_lines import LINES

from daedalus.learner.run import run_directory
from daedalus.learner.run.heartbeat import HEARTBEAT, Heartbeat
from daedalus.learner.run.process_resources import reserve_descriptors
from daedalus.learner.serving.evaluations import Evaluated
from daedalus.learner.serving.run_context import Health, RunContext
from daedalus.learner.training import checkpointer as module
from daedalus.learner.training.checkpoint import load_checkpoint, load_newest
from daedalus.learner.training.checkpointer import Checkpointer, Saving
from daedalus.learner.training.learner import Learner
from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_in_training, keep_if_best
from daedalus.policy.saving.saved_policy import checkpoints, find_policy, read_candidates, read_policy
from daedalus.policy.saving.sealed import SealedDirectory
from daedalus.protocol.messages import new_epoch
from daedalus.protocol.spec import RunSpec, TrainingSpec


class Run:
    """A learner and its checkpointer."""

    def __init__(self, directory: Path, spec: RunSpec | None = None, context: RunContext | None = None) -> None:
        self.directory = directory
        self.state = context or run_context(spec, directory)
        self.learner = Learner(TrainingSpec(), POLICY, SPACES)
        self.checkpointer = Checkpointer(self.state, self.learner, b"program")

    def train(self, seed: int = 1) -> None:
        self.learner.step(make_rollouts(seed), 0.0)

    def save(self, **how: Any) -> Saving:
        """Save a checkpoint to the end."""
        saving = self.checkpointer.begin(**how)
        self.checkpointer.wait(saving, lambda: None)
        return saving

    def finish_last(self) -> bool:
        """Save the last checkpoint of a learner that is stopped; return whether it is saved."""
        self.state.stop.set()
        return self.checkpointer.wait(self.checkpointer.begin(last=True), lambda: None)

    @property
    def problems(self) -> tuple[str, ...]:
        """What the status reports, far in the future."""
        self.state.health.note_update(1e9)
        return self.state.health.problems(1e9, 1)

    @property
    def texts(self) -> list[str]:
        return [event.text for event in self.state.events.report()]


class Disk:
    """A disk whose fsync waits while it is stuck."""

    def __init__(self) -> None:
        self._free, self.reached = threading.Event(), threading.Event()
        self._free.set()

    def fsync(self, _descriptor: int) -> None:
        self.reached.set()
        self._free.wait()

    def stick(self) -> None:
        self._free.clear()
        self.reached.clear()

    def free(self) -> None:
        self._free.set()


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    made = Disk()
    monkeypatch.setattr(os, "fsync", made.fsync)
    yield made
    made.free()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path)


def written(directory: Path) -> int:
    """Return a number that changes with every writing of a checkpoint."""
    return (directory / "manifest.json").stat().st_ino


def test_a_version_is_saved_once_for_evaluations(run: Run) -> None:
    first = run.save(again=False)
    assert first.is_saved
    before = written(first.directory)
    assert run.save(again=False).directory == first.directory
    assert written(first.directory) == before
    run.train()
    second = run.save(again=False)
    assert read_policy(second.directory).policy_version == 1
    shutil.rmtree(second.directory)
    assert run.save(again=False).directory.is_dir()


def test_a_version_whose_saving_failed_is_saved_again(run: Run) -> None:
    (run.directory / "checkpoints").write_text("in the way")
    failed = run.save(again=False)
    assert not failed.is_saved
    assert failed.result == f"checkpoint not saved: {run.state.health.save_fault}"
    (run.directory / "checkpoints").unlink()
    assert run.save(again=False).is_saved
    assert not run.state.health.save_fault


def test_a_run_whose_directory_was_removed_can_be_resumed(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    run_directory.create(directory, run_spec())
    run = Run(directory)
    run.save()
    shutil.rmtree(directory)
    assert run.save().is_saved
    assert run_directory.read_config(directory) == run_spec()
    assert any("was moved or removed: the run continues in a new one" in text for text in run.texts)
    run.save()
    assert sum("moved or removed" in text for text in run.texts) == 1


# ------------------------------------------------------------------------------------------------- a slow disk


def test_a_checkpoint_is_of_the_moment_when_it_was_begun_although_training_goes_on(run: Run, disk: Disk) -> None:
    run.train()
    other = Learner(TrainingSpec(), POLICY, SPACES)
    disk.stick()
    saving = run.checkpointer.begin()
    assert disk.reached.wait(30.0)
    run.train(2)
    expected = {name: array.copy() for name, array in run.learner.weights().items()}
    assert not run.checkpointer.idle
    disk.free()
    assert run.checkpointer.wait(saving, lambda: None)
    saved = load_checkpoint(saving.directory)
    assert saved.policy.policy_version == 1
    other.restore(1, saved.policy.weights, saved.state)
    other.step(make_rollouts(2), 0.0)
    for name, array in other.weights().items():
        np.testing.assert_array_equal(array, expected[name])


def test_a_slow_disk_is_a_problem_until_the_checkpoint_is_saved(
    run: Run, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk.stick()
    saving = run.checkpointer.begin()
    assert disk.reached.wait(30.0)
    (problem,) = run.problems
    assert problem.startswith("the checkpoint has been writing for ")
    assert problem.endswith(f" s: the disk of {run.directory} is slow; training continues")
    monkeypatch.setattr(module, "SLOW_DISK_SECONDS", 0.0)
    disk.free()
    assert run.checkpointer.wait(saving, lambda: None)
    assert run.save().is_saved  # the first one is completely done
    assert run.problems == ()
    assert any(text.endswith(" s: the disk is slow") for text in run.texts)


def test_a_stuck_disk_does_not_keep_a_learner_from_ending_and_the_earlier_checkpoint_stays(
    run: Run, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.state.counters.env_steps = 1000
    first = run.save()
    run.train()
    run.state.counters.env_steps = 4000
    monkeypatch.setattr(module, "STOP_SECONDS", 0.1)
    disk.stick()
    run.checkpointer.begin()
    run.train(2)
    run.state.counters.env_steps = 5500
    assert not run.finish_last()
    (line,) = (line for line in LINES if line.startswith("the last checkpoint"))
    assert line.endswith(
        f" s: the disk of {run.directory} is slow; a resumed run continues from 1,000 env_steps, "
        "and the last 4,500 are lost"
    )
    assert checkpoints(run.directory) == [first.directory]
    assert load_newest(run.directory).policy.policy_version == 0


def test_an_evaluated_checkpoint_is_kept_although_newer_ones_are_saved_before(tmp_path: Path, disk: Disk) -> None:
    """The result comes while the next checkpoint is being written, which would displace the evaluated one."""
    spec = run_spec().model_copy(update={"service": run_spec().service.model_copy(update={"keep_checkpoints": 1})})
    run = Run(tmp_path, spec)
    evaluated = run.save(again=False)
    run.state.evaluations.begin("e", evaluated.directory, 0, 0)
    run.train()
    disk.stick()
    run.checkpointer.begin()
    del run.state.evaluations.in_progress["e"]
    run.checkpointer.keep(Evaluated(evaluated.directory, 0, 7.0, "evaluation"))
    disk.free()
    run.train(2)
    run.save()
    assert [each.name for each in best_checkpoints(tmp_path)] == ["best_7.0_0000000000"]
    assert [each.name for each in checkpoints(tmp_path)] == ["0000000002"]


def test_problems_name_metrics_that_are_not_written() -> None:
    state = Health(started=0.0, updated=50.0, actor_seen=50.0, directory="runs/x", recording_since=lambda: 10.0)
    text = "metrics have been writing for 40 s: the disk of runs/x is slow; training continues"
    assert state.problems(50.0, 1) == (text,)
    assert state.problems(20.0, 1) == ()


# ------------------------------------------------------------------------------------- the best, without evaluator


def collapse(run: Run, *returns: float) -> list[str]:
    """Save a checkpoint after each window of training episodes with this mean return, and return the best."""
    for number, mean in enumerate(returns):
        run.train(number)
        run.state.counters.returns.extend([mean] * run.state.counters.target_episodes)
        run.save()
    return [each.name for each in best_in_training(run.directory)]


def test_the_good_weights_of_a_run_that_collapses_without_evaluator_are_kept(run: Run) -> None:
    assert collapse(run, 100.0, 480.0, 300.0) == ["0000000002", "0000000003", "0000000001"]
    assert find_policy(run.directory).policy_version == 2
    assert [each.policy_version for each in read_candidates(run.directory)] == [2, 3, 1]
    assert collapse(run, 490.0, *[9.0] * 8) == [
        "best_training_490.0_0000000004",
        "best_training_480.0_0000000002",
        "best_training_300.0_0000000003",
    ]
    assert [each.name for each in checkpoints(run.directory)] == ["0000000012", "0000000011", "0000000010"]
    assert len([*(run.directory / "checkpoints").iterdir()]) == 6
    best = find_policy(run.directory)
    assert best.policy_version == 4
    assert find_policy(run.directory, newest=True).policy_version == 12
    of = "the newest 100 training episodes"
    assert SealedDirectory(best.directory).content["score"] == {"return_mean": 490.0, "episodes": 100, "of": of}
    assert [each.policy_version for each in read_candidates(run.directory)] == [4, 2, 3, 12]
    keep_if_best(checkpoints(run.directory)[0], -5.0, 12)  # an evaluator has come: its score is not of the same kind
    assert find_policy(run.directory).policy_version == 12


def test_what_was_worse_in_training_before_the_first_evaluation_is_no_candidate(run: Run) -> None:
    assert collapse(run, -5.0, 0.0) == ["0000000002", "0000000001"]
    keep_if_best(checkpoints(run.directory)[1], -7.0, 1)
    run.state.evaluations.heard = module.time.monotonic()
    collapse(run, -1.0)
    assert [each.policy_version for each in read_candidates(run.directory)] == [1, 2, 3], "0 is more than -1"
    collapse(run, 14.0)
    assert [each.policy_version for each in read_candidates(run.directory)] == [1, 4]


@pytest.mark.parametrize(
    ("settings", "other"),
    [({"training_kwargs": {"bonus": 1.0}}, True), ({"no_reward_limit": 9}, True), ({"training_kwargs": {}}, False)],
)
def test_training_returns_of_another_task_are_called_so(tmp_path: Path, settings: dict, other: bool) -> None:
    spec = run_spec()
    run = Run(tmp_path, spec.model_copy(update={"environment": spec.environment.model_copy(update=settings)}))
    collapse(run, 5.0)
    score = SealedDirectory(checkpoints(tmp_path)[0]).content["score"]
    task = ", of another task (environment.training_kwargs, environment.no_reward_limit or lessons)" if other else ""
    assert score["of"] == f"the newest 100 training episodes{task}"


def test_training_returns_of_too_few_episodes_or_of_an_evaluated_run_are_no_scores(run: Run) -> None:
    run.state.counters.returns.extend([500.0] * 99)
    run.save()
    assert best_in_training(run.directory) == []
    run.state.evaluations.heard = module.time.monotonic()
    assert collapse(run, 500.0) == []
    run.state.evaluations.heard -= 601.0  # the evaluator was lost
    assert len(collapse(run, 500.0)) == 1
    assert read_candidates(run.directory) == []  # the newest is the best


def test_a_learner_that_resumes_is_newer_than_every_learner_before_its_checkpoint(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.save()

    def resumed() -> RunContext:
        return RunContext.begin(tmp_path, run_spec(), threading.Event(), restored=load_newest(tmp_path))

    first = RunContext.begin(tmp_path, run_spec(), threading.Event())
    copies = [resumed() for _ in range(20)]
    assert all(first.learner_epoch < copy.learner_epoch < 2**62 for copy in copies)
    assert len({copy.learner_epoch for copy in copies}) == len(copies)
    Run(tmp_path, context=copies[0]).save()
    after = resumed()
    assert after.learner_epoch > max(copy.learner_epoch for copy in copies)
    assert new_epoch(10**9) < 2**62


@pytest.fixture
def every_descriptor() -> Iterator[Callable[[], None]]:
    """Return a function that opens files until this process may open no more."""
    before, files = resource.getrlimit(resource.RLIMIT_NOFILE), []

    def take() -> None:
        with suppress(OSError):
            while True:
                files.append(os.open(os.devnull, os.O_RDONLY))

    resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 256, before[1]))
    reserve_descriptors()
    yield take
    for file in files:
        os.close(file)
    resource.setrlimit(resource.RLIMIT_NOFILE, before)
    reserve_descriptors(0)


def test_checkpoint_is_saved_while_connections_hold_every_other_descriptor(
    tmp_path: Path, every_descriptor: Callable[[], None]
) -> None:
    run = Run(tmp_path)
    every_descriptor()
    assert run.save().is_saved
    with pytest.raises(OSError, match="Too many open files"):
        os.open(os.devnull, os.O_RDONLY)  # which the next connection would get
    run.train()
    assert run.finish_last()
    Heartbeat(tmp_path).beat()
    assert (tmp_path / HEARTBEAT).exists()
