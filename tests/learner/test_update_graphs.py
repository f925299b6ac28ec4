"""The updates of a batch as a GPU makes them, without one: no value is read, results come late, and it may fail."""

import weakref
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from building import ENVIRONMENTS, ROWS, SPACES, identity, join, make_rollout
from test_cuda import KINDS, rollouts
from torch.utils._python_dispatch import TorchDispatchMode

from daedalus.algorithms.gradients import GradientComputer
from daedalus.learner.run.settings import DeviceLostError, SettingsError
from daedalus.learner.training.learner import Learner
from daedalus.learner.training.optimizers import UpdateStep
from daedalus.learner.training.update_graphs import driver_faults, memory_faults
from daedalus.learner.training.update_metrics import UpdateMetrics
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

aten = torch.ops.aten
WAITING = {aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default, aten.lift_fresh.default}


class NoValueIsRead(TorchDispatchMode):
    """Fails at an operation that a CUDA graph cannot record: it reads a value, or brings one from main memory."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # torch would otherwise import its compiler, which takes a second

    def __torch_dispatch__(self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None) -> Any:
        assert func not in WAITING, func
        if func is aten.index.Tensor:
            assert all(each is None or each.dtype != torch.bool for each in args[1])
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("optimizer", ["adam", "rmsprop"])
@pytest.mark.parametrize(
    "kind", [kind for kind in KINDS if "article" not in kind]
)  # whose layer on a CPU reads a slope
@pytest.mark.parametrize("algorithm", ["a2c", "impala", "appo"])
def test_updates_read_no_value(algorithm: str, kind: str, optimizer: str) -> None:
    policy, spaces = KINDS[kind]
    spec = TrainingSpec.model_validate({"algorithm": algorithm, "optimizer": optimizer})
    network = ActorCritic(policy, spaces, training=spec)
    computer = GradientComputer(spec, network, spaces)
    metrics = UpdateMetrics(spaces, torch.device("cpu"), spec.max_gradient_norm)
    step = UpdateStep(spec, computer.parameters, metrics)
    batch = join(rollouts(1, spaces, network.state_size), spaces)
    has_memory = network.state_size > 0
    passes = computer.algorithm.drawn(batch.valid, has_memory=has_memory)
    step.begin(1e-3)
    before = computer.parameters.values.clone()
    batch, bonus = replace(batch, passes=passes), torch.tensor(0.01)
    with NoValueIsRead():
        for _ in computer.compute(batch, bonus, step):
            pass
    made = spec.updates_from(batch.valid.shape[1] if has_memory else int(batch.valid.sum()))
    assert step.end() == (made, False)
    assert not torch.equal(computer.parameters.values, before)


BAD: dict[str, Any] = {"rewards": np.full((ROWS, ENVIRONMENTS), np.inf, np.float32)}


def batches(*bad_ones: str) -> list[list[Rollout]]:
    """Return batches of the rollouts of two actors, and which of each have no finite gradient."""
    made = []
    for number, names in enumerate(bad_ones):
        bad = dict.fromkeys(names, BAD)
        actors = [identity(actor, number) for actor in "ab"]
        made.append([make_rollout(each, seed=number, **bad.get(each.actor, {})) for each in actors])
    return made


@pytest.mark.parametrize(
    ("algorithm", "bad"),
    # A repeated batch of appo draws its minibatches after the next one.
    [("impala", ("", "b", "ab", "")), ("appo", ("", "", ""))],
)
def test_updates_that_are_launched_as_one_and_end_late_equal_those_one_by_one(
    algorithm: str, bad: tuple[str, ...]
) -> None:
    found: list[tuple[Learner, list[str]]] = []
    for is_late in (True, False):
        spec = TrainingSpec.model_validate({"algorithm": algorithm})
        trained = Learner(spec, PolicySpec(hidden=(8,)), SPACES)  # seeds the order of minibatches
        trained.overlaps = trained.graphs.records = is_late
        left_out = [each for batch in batches(*bad) for each in trained.step(batch, 0.1)]
        found.append((trained, [each.identity.actor for each in left_out + trained.finish()]))
    (late, late_names), (prompt, names) = found
    assert late_names == names == list("".join(bad))
    assert late.finish() == []
    assert late.policy_version == prompt.policy_version
    assert late.updates_skipped == prompt.updates_skipped == bad.count("ab")
    for name, expected in {**prompt.state(), **prompt.weights()}.items():
        np.testing.assert_array_equal({**late.state(), **late.weights()}[name], expected, err_msg=name)
    assert late.metrics.take_means() == prompt.metrics.take_means()


def test_too_little_memory_is_reported_with_the_number_of_rows_that_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    compute = GradientComputer.compute

    def limited(self: GradientComputer, batch: Any, *arguments: Any) -> Iterator[Any]:
        if batch.rewards.numel() > 2 * ROWS:
            raise torch.OutOfMemoryError("CUDA out of memory")
        yield from compute(self, batch, *arguments)

    monkeypatch.setattr(GradientComputer, "compute", limited)
    learner = Learner(TrainingSpec(algorithm="impala"), PolicySpec(hidden=(8,)), SPACES)
    with pytest.raises(SettingsError, match=rf"batch of {4 * ROWS} rows do not fit .*; {2 * ROWS} rows fit"):
        learner.step([make_rollout(environments=4)], 0.0)


def test_what_a_failed_attempt_held_is_released_before_the_fitting_rows_are_sought() -> None:
    class Held:
        pass

    held: list[weakref.ref[Held]] = []

    def attempt() -> None:
        tensors = Held()
        held.append(weakref.ref(tensors))
        raise torch.OutOfMemoryError("CUDA out of memory")

    with pytest.raises(SettingsError, match="; 4 rows fit"), memory_faults(8, lambda: 4 if held[0]() is None else 0):
        attempt()


def test_a_device_that_fails_is_reported_in_one_line() -> None:
    with (
        pytest.raises(DeviceLostError, match=r"^the GPU has failed: .*unspecified launch failure.* resume the run$"),
        driver_faults(),
    ):
        raise RuntimeError("CUDA error: unspecified launch failure\nCompile with ...")


def test_a_card_without_bfloat16_is_refused_if_the_run_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: including_emulation)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "Tesla T4")
    with pytest.raises(SettingsError, match="bfloat16, which Tesla T4 does not multiply"):
        Learner(TrainingSpec(device="cuda", precision="bfloat16"), PolicySpec(), SPACES)
