"""An algorithm of the user's own: it is found, tried before the run, and scheduled by its record."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from building import POLICY, RECURRENT, SPACES, identity, join, make_rollout, make_rollouts, run_spec

from daedalus.algorithms.gradients import GradientComputer
from daedalus.algorithms.recording import EARLIER_CALLS
from daedalus.algorithms.rollout_gradients import RolloutGradients
from daedalus.cli.commands.learner import learner_options, parser
from daedalus.launch.learner_process import choose_run
from daedalus.launch.run_choice import with_record
from daedalus.learner.run import run_directory
from daedalus.learner.run.resuming import CheckpointMismatchError
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_modules import ModuleNotAllowedError, UserModules
from daedalus.protocol.algorithms import AlgorithmError
from daedalus.protocol.compact import bfloat16, float32
from daedalus.protocol.spec import PolicySpec, RunSpec, TrainingSpec

MODULE = "own_algorithms"
CODE = """
import torch
from daedalus.algorithms.algorithm import Algorithm
from daedalus.algorithms.policy_gradient import Appo
from daedalus.algorithms.policy_gradient import A3c
from daedalus.protocol.algorithms import AlgorithmRecord

class Barrier(A3c):
    record = AlgorithmRecord(synchronous=True)

class Twice(Algorithm):
    def losses(self, batch, forward):
        yield from A3c(self.spec, self.distribution).losses(batch, forward)
        yield from A3c(self.spec, self.distribution).losses(batch, forward)

class Passes(Appo):
    record = AlgorithmRecord(passes_over_batch=True, corrected=True, batch_rollouts=5, max_lag_batches=2)

    def value_loss(self, minibatch, values):
        return super().value_loss(minibatch, values) + 0.0

class Unfinished(Algorithm):
    pass

class WrongShape(A3c):
    def losses(self, batch, forward):
        for losses in super().losses(batch, forward):
            yield losses._replace(targets=losses.targets[:-1])

class Other(A3c):
    change = staticmethod(lambda losses: losses)

    def losses(self, batch, forward):
        for losses in super().losses(batch, forward):
            yield self.change(losses)

class Transposed(Other):
    change = staticmethod(lambda losses: losses._replace(entropies=losses.entropies.T))

class NoScalar(Other):
    change = staticmethod(lambda losses: losses._replace(policy_loss=losses.policy_loss[None]))

class NoTensor(Other):
    change = staticmethod(lambda losses: losses._replace(policy_loss=0.0))

class NoLosses(Other):
    change = staticmethod(lambda losses: losses.policy_loss)

class NoRecord(A3c):
    record = {"synchronous": True}

class Random(A3c):
    def __init__(self, spec, distribution, *, draws):
        super().__init__(spec, distribution)
        self.draws = draws

    def losses(self, batch, forward):
        torch.rand(self.draws)
        yield from super().losses(batch, forward)

class Counting(A3c):
    record = AlgorithmRecord(target_network=True)

    def __init__(self, spec, distribution):
        super().__init__(spec, distribution)
        self.statistics = {"updates": torch.zeros(())}

    def after_update(self, policy_version, forward):
        self.statistics["updates"] += 1
        assert self.statistics["updates"] == policy_version

class Stopping(Appo):
    record = AlgorithmRecord(passes_over_batch=True)

    def losses(self, batch, forward):
        for index, losses in enumerate(super().losses(batch, forward)):
            if index == (2 if batch.rewards.any() else 0):  # at once in the trial before the run
                return
            yield losses

class Adaptive(A3c):
    record = AlgorithmRecord(synchronous=True)

    def __init__(self, spec, distribution):
        super().__init__(spec, distribution)
        self.statistics = {
            "weight": torch.tensor([1.0, torch.inf]),
            "updates": torch.tensor(1_000_000),
            "odd": torch.tensor(False),
        }

    def losses(self, batch, forward):
        weight = self.statistics["weight"][0] * (self.statistics["updates"] % 3) + self.statistics["odd"]
        for losses in super().losses(batch, forward):
            yield losses._replace(policy_loss=losses.policy_loss * weight)

    def after_update(self, policy_version, forward):
        self.statistics["weight"].mul_(1.0 / 3.0)
        self.statistics["updates"].add_(1)
        self.statistics["odd"].logical_not_()

class Fading(Appo):
    record = AlgorithmRecord(passes_over_batch=True)

    def __init__(self, spec, distribution):
        super().__init__(spec, distribution)
        self.weight, self.statistics = 100, {"updates": torch.zeros(())}

    def value_loss(self, minibatch, values):
        return 0.0 * values.sum() + self.weight + self.statistics["updates"]

    def after_update(self, policy_version, forward):
        self.weight -= 10
        self.statistics = {"updates": self.statistics["updates"] + 1}

class FaultyAfter(A3c):
    def after_update(self, policy_version, forward):
        forward.update_target()

number = 3
"""


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> UserModules:
    """The user's module, in the working directory."""
    (tmp_path / f"{MODULE}.py").write_text(CODE)
    (tmp_path / "broken.py").write_text("raise RuntimeError('no licence')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in (MODULE, "broken"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return UserModules(frozenset({MODULE, "broken"}))


def training(name: str, **fields: Any) -> TrainingSpec:
    return TrainingSpec.model_validate({"algorithm": f"{MODULE}:{name}", **fields})


def resolved(modules: UserModules, name: str, **fields: Any) -> RunSpec:
    return with_record(run_spec(algorithm=f"{MODULE}:{name}", **fields), modules)


def test_the_record_of_the_class_schedules_the_run(modules: UserModules) -> None:
    unresolved = run_spec(algorithm=f"{MODULE}:Barrier")
    assert not unresolved.algorithm.synchronous
    assert with_record(unresolved, modules).algorithm.synchronous
    passes = resolved(modules, "Passes", passes=2, minibatches=3)
    assert (passes.batch_rollouts, passes.training.updates_per_batch, passes.policy_lag_bound_with(0)) == (5, 6, 12)
    with pytest.raises(SettingsError, match="batch_rollouts has no meaning for own_algorithms:Barrier"):
        resolved(modules, "Barrier", batch_rollouts=2)


@pytest.mark.parametrize("policy", [POLICY, RECURRENT])
@pytest.mark.parametrize(("name", "same"), [("Barrier", "a2c"), ("Passes", "appo")])
def test_an_own_algorithm_learns_as_its_base_does(
    modules: UserModules, name: str, same: str, policy: PolicySpec
) -> None:
    """The trial before the run leaves no trace: neither in the parameters nor in the random state."""
    learners = []
    for spec in (resolved(modules, name).training, TrainingSpec(algorithm=same)):
        learner = Learner(spec, policy, SPACES, modules)
        assert learner.take_diagnostics() == {}
        for seed in range(2):
            learner.step(make_rollouts(seed, state_size=learner.state_size), 0.0)
        learners.append(learner)
    own, base = learners
    assert own.policy_version == base.policy_version
    assert all(np.array_equal(values, base.weights()[key]) for key, values in own.weights().items())


def test_arguments_reach_the_constructor(modules: UserModules) -> None:
    Learner(training("Random", algorithm_kwargs={"draws": 3}), POLICY, SPACES, modules)
    with pytest.raises(AlgorithmError, match=r"own_algorithms:Random: TypeError: .*draws"):
        Learner(training("Random"), POLICY, SPACES, modules)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (f"{MODULE}:Unfinished", "NotImplementedError"),
        (f"{MODULE}:Twice", "its losses make 2 updates of a batch, and its record says 1"),
        (f"{MODULE}:WrongShape", "ValueError: the shapes of entropies, values, targets and shares differ"),
        (f"{MODULE}:Transposed", "ValueError: the shapes of entropies, values, targets and shares differ"),
        (f"{MODULE}:NoScalar", "ValueError: policy_loss has shape (1,): it must be a scalar"),
        (f"{MODULE}:NoTensor", "TypeError: policy_loss is float: it must be a tensor; zero is torch.zeros(())"),
        (f"{MODULE}:NoLosses", "TypeError: losses() gives Tensor: it must yield Losses or MinibatchLosses"),
        (f"{MODULE}:FaultyAfter", "there is no target network: set target_network in the record of the algorithm ("),
        (f"{MODULE}:NoRecord", "its record is not an AlgorithmRecord"),
        (f"{MODULE}:number", "it is not a class of daedalus.algorithms.algorithm.Algorithm"),
        (f"{MODULE}:absent", "has no 'absent'"),
        ("broken:A", "RuntimeError: no licence"),
        ("other:A", "asks for training.algorithm=other:A, but the module other may not be imported here"),
    ],
)
def test_a_fault_is_reported_in_one_line_before_the_run(modules: UserModules, name: str, reason: str) -> None:
    with pytest.raises(AlgorithmError) as caught:
        Learner(TrainingSpec(algorithm=name), POLICY, SPACES, modules)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_algorithm_may_stop_its_passes_early(modules: UserModules) -> None:
    """Such as at a KL bound. The actors expect the versions of the whole batch; no gradient was at fault."""
    learner = Learner(resolved(modules, "Stopping", passes=2, minibatches=3).training, POLICY, SPACES, modules)
    for version in (6, 12):
        before = {name: values.copy() for name, values in learner.weights().items()}
        assert learner.step(make_rollouts(version), 0.0) == []
        assert (learner.policy_version, learner.updates_skipped) == (version, 0)
        assert any(not np.array_equal(values, before[name]) for name, values in learner.weights().items())
        assert learner.take_diagnostics()


def test_what_follows_an_update_is_saved_and_restored(modules: UserModules) -> None:
    spec = resolved(modules, "Counting")
    first, second = (Learner(spec.training, POLICY, SPACES, modules) for _ in range(2))
    for step in range(3):
        first.step(make_rollouts(step), 0.0)
    state = {name: values.clone() for name, values in first.state().items()}
    assert float(state["algorithm/updates"]) == 3.0
    second.restore(3, {name: values.copy() for name, values in first.weights().items()}, state)
    second.step(make_rollouts(9), 0.0)
    assert float(second.state()["algorithm/updates"]) == 4.0
    del state["algorithm/updates"]  # the class has got them since
    with pytest.raises(CheckpointMismatchError, match="'algorithm/updates': restore the class own_algorithms:Counting"):
        second.restore(3, first.weights(), state)


def test_losses_follow_the_attributes_that_change_after_an_update(modules: UserModules) -> None:
    """Also once the operations of a minibatch are recorded. The trial before the run leaves them as they were."""
    spec = resolved(modules, "Fading", passes=10, minibatches=3).training
    computer = GradientComputer(spec, ActorCritic(POLICY, SPACES, training=spec), SPACES, modules)
    terms = []
    for version, each in enumerate(computer.compute(join(make_rollouts(0)), 0.0), start=1):
        terms.append(float(each.value_loss))
        computer.after_update(version)
    assert len(terms) > EARLIER_CALLS + 5
    assert terms == [100 - 9 * update for update in range(len(terms))]


def test_actors_that_compute_gradients_have_the_statistics_of_the_learner(modules: UserModules) -> None:
    """Also with compact snapshots, which are rounded."""
    spec = resolved(modules, "Adaptive")
    collection = spec.collection.model_copy(update={"upload": "gradients"})
    spec = RunSpec.model_validate({**spec.model_dump(), "collection": collection.model_dump()})
    by_rollouts, by_gradients = (Learner(spec.training, POLICY, SPACES, modules) for _ in range(2))
    actor = RolloutGradients(spec.learning, SPACES, modules)
    for sequence in range(4):
        inputs = float32(bfloat16(by_gradients.gradient_inputs(0.0)))
        actor.load({name: values.copy() for name, values in by_gradients.weights().items()} | inputs)
        rollout = make_rollout(identity(sequence=sequence), seed=sequence)
        by_gradients.apply([actor.compute(rollout)], 0.0)
        by_rollouts.step([rollout], 0.0)
        for name, values in by_rollouts.weights().items():
            assert np.array_equal(by_gradients.weights()[name], values), name
    missing = {**by_gradients.weights(), **by_gradients.gradient_inputs(0.0)}
    del missing["algorithm/weight"]
    with pytest.raises(PolicyError, match="no numbers to compute gradients with: 'algorithm/weight'"):
        actor.load(missing)


def test_the_run_directory_holds_the_settings_and_not_the_record(modules: UserModules, tmp_path: Path) -> None:
    spec = resolved(modules, "Random", algorithm_kwargs={"draws": 3})
    run_directory.create(tmp_path / "run", spec)
    assert run_directory.read_config(tmp_path / "run") == run_spec(
        algorithm=f"{MODULE}:Random", algorithm_kwargs={"draws": 3}
    )
    assert run_directory.default_directory("Any-v0", spec).name.startswith("Any-v0-Random-s1-")


def test_a_resumed_learner_imports_the_algorithm_only_if_allowed(modules: UserModules, tmp_path: Path) -> None:
    run_directory.create(tmp_path / "run", run_spec(algorithm=f"{MODULE}:Barrier"))
    words = ["--run-dir", str(tmp_path / "run"), "--resume"]
    with pytest.raises(ModuleNotAllowedError, match=f"asks for training.algorithm={MODULE}:Barrier"):
        choose_run(learner_options(parser().parse_args(words), 0.0, Path()))
    chosen = choose_run(learner_options(parser().parse_args([*words, "--allow-module", MODULE]), 0.0, Path()))
    assert chosen.spec.algorithm.synchronous


def test_arguments_of_a_built_in_algorithm_are_refused() -> None:
    with pytest.raises(ValueError, match="algorithm_kwargs is for an algorithm of your own"):
        run_spec(algorithm="impala", algorithm_kwargs={"x": 1})
    with pytest.raises(ValueError, match="algorithm_record is for an algorithm of your own"):
        run_spec(algorithm="impala", algorithm_record={"synchronous": True})
