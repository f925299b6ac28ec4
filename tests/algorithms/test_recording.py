"""algorithms/recording.py: a recording computes what its function computes, and what cannot be recorded still works."""

import subprocess
import sys
from collections.abc import Callable, Sequence

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from daedalus.algorithms import recording
from daedalus.algorithms.batch import Batch, BatchAssembler
from daedalus.algorithms.gradients import GradientComputer
from daedalus.algorithms.policy_gradient import Appo
from daedalus.algorithms.recording import OperationRecorder, OperationTape, TapeError
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec, TrainingSpec

ROWS, ENVIRONMENTS, MINIBATCHES, PASSES = 8, 4, 4, 2
STATE = ArraySpace(shape=(5,), dtype="float32", frames=1)
COMPOSITE: dict[str, ArraySpace | DiscreteSpace] = {
    "camera": ArraySpace(shape=(4, 4, 1), dtype="uint8", frames=2),
    "place": DiscreteSpace(counts=(3, 2)),
    "state": STATE,
}
ARM = ContinuousSpace(low=(-1.0, -2.0), high=(1.0, 2.0))
GRIPPER = DiscreteSpace(counts=(3,), masked=True)


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "EARLIER_CALLS", 0)


class Counted:
    """A function that counts its calls."""

    def __init__(self, weight: Tensor) -> None:
        self.weight, self.calls = weight, 0

    def __call__(self, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
        self.calls += 1
        (values,) = tensors
        return (torch.autograd.grad((values * self.weight).tanh().sum(), self.weight)[0],)


def test_recording_repeats_the_function_with_the_values_of_the_moment() -> None:
    weight = torch.ones(3, requires_grad=True)
    function, recorder = Counted(weight), OperationRecorder()
    recorder.call("gradient", function, [torch.zeros(3)])
    calls = function.calls
    for step in range(5):
        values = torch.randn(3)
        with torch.no_grad():
            weight += 0.1 * step
        (result,) = recorder.call("gradient", function, [values])
        assert not result.requires_grad
        torch.testing.assert_close(result, values * (1.0 - (values * weight.detach()).tanh().square()))
    assert function.calls == calls


def test_few_calls_are_not_worth_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "EARLIER_CALLS", 3)
    function, recorder = Counted(torch.ones(3, requires_grad=True)), OperationRecorder()
    calls: list[int] = []
    for _ in range(6):
        recorder.call("gradient", function, [torch.zeros(3)])
        calls.append(function.calls)
    assert calls == [1, 2, 3, 5, 5, 5]  # the fourth is also recorded


def test_each_shape_and_each_name_has_a_recording_of_its_own() -> None:
    recorder = OperationRecorder()
    for size in (2, 3):
        for _ in range(2):
            assert torch.equal(recorder.call("one", lambda t: (t[0] + 1.0,), [torch.zeros(size)])[0], torch.ones(size))
            two = recorder.call("two", lambda t: (t[0] + 2.0,), [torch.zeros(size)])
            assert torch.equal(two[0], torch.full((size,), 2.0))


def test_function_that_depends_on_values_is_called_as_it_is() -> None:
    recorder = OperationRecorder()
    for value in (1.0, -1.0, 1.0):
        (sign,) = recorder.call(
            "sign", lambda t: (t[0].abs() if t[0].sum() > 0 else -t[0].abs(),), [torch.tensor(value)]
        )
        assert float(sign) == value


def test_function_that_draws_is_called_as_it_is() -> None:
    recorder = OperationRecorder()
    drawn = [recorder.call("noise", lambda t: (t[0] + torch.rand(4),), [torch.zeros(4)])[0] for _ in range(3)]
    torch.manual_seed(1)
    expected = torch.rand(4)
    torch.manual_seed(1)
    assert torch.equal(recorder.call("noise", lambda t: (t[0] + torch.rand(4),), [torch.zeros(4)])[0], expected)
    assert not torch.equal(drawn[0], drawn[1])


def test_results_that_are_not_finite_are_not_what_a_recording_is_checked_with() -> None:
    recorder, calls = OperationRecorder(), []

    def inverse(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
        calls.append(1)
        return (1.0 / tensors[0],)

    assert recorder.call("inverse", inverse, [torch.tensor(0.0)])[0].isinf()
    assert len(calls) == 1
    for value in (2.0, 4.0, 0.0):
        assert float(recorder.call("inverse", inverse, [torch.tensor(value)])[0]) == (
            1.0 / value if value else torch.inf
        )
    assert len(calls) == 3  # with 0, with 2, and for the recording


def random_batch(spaces: Spaces, state_size: int, seed: int) -> Batch:
    """Return a batch with random content, in which all actions are legal and some rows do not count."""
    generator = torch.Generator().manual_seed(seed)
    batch = BatchAssembler(spaces, torch.device("cpu")).allocate(ROWS, ENVIRONMENTS, state_size)
    for name, space in {**spaces.observations, **spaces.actions}.items():
        values = (batch.observations | batch.actions)[name]
        if isinstance(space, DiscreteSpace):
            drawn = [torch.randint(count, values.shape[:-1], generator=generator) for count in space.counts]
            values.copy_(torch.stack(drawn, -1))
        elif values.dtype == torch.uint8:
            values.random_(0, 256, generator=generator)
        else:
            values.uniform_(-0.9, 0.9, generator=generator)
    for mask in batch.masks.values():
        mask.fill_(True)
    batch.behaviour_log_probs.uniform_(-2.0, -1.0, generator=generator)
    batch.rewards.normal_(generator=generator)
    batch.initial_state.uniform_(-1.0, 1.0, generator=generator)
    batch.starts[1:].copy_(torch.rand(batch.starts[1:].shape, generator=generator) < 0.2)
    batch.valid.copy_(torch.rand(batch.valid.shape, generator=generator) < 0.8)
    return batch.to(torch.device("cpu"))


@pytest.mark.parametrize(
    ("observations", "actions", "policy"),
    [
        pytest.param({"state": STATE}, {"arm": ARM}, {"activation": "relu"}, id="gaussian"),
        pytest.param({"state": STATE}, {"arm": ARM}, {"state_dependent_std": True}, id="state dependent"),
        pytest.param({"state": STATE}, {"arm": ARM}, {"distribution": "squashed_gaussian"}, id="squashed"),
        pytest.param({"state": STATE}, {"arm": ARM}, {"distribution": "kumaraswamy"}, id="kumaraswamy"),
        pytest.param({"state": STATE}, {"arm": ARM}, {"distribution": "gaussian_mixture"}, id="mixture"),
        pytest.param(COMPOSITE, {"arm": ARM, "gripper": GRIPPER}, {"encoder": "mlp"}, id="composite"),
        pytest.param(COMPOSITE, {"gripper": GRIPPER}, {"hidden": (), "encoder": "mlp"}, id="masked, no layers"),
        pytest.param({"state": STATE}, {"gripper": GRIPPER}, {"memory": "gru", "memory_units": 4}, id="memory"),
    ],
)
def test_recorded_updates_equal_those_without_a_recording(
    monkeypatch: pytest.MonkeyPatch,
    observations: dict[str, ArraySpace | DiscreteSpace],
    actions: dict[str, ContinuousSpace | DiscreteSpace],
    policy: dict[str, object],
) -> None:
    spaces = Spaces(observations=observations, actions=actions)
    spec = TrainingSpec(algorithm="appo", passes=PASSES, minibatches=MINIBATCHES, entropy_bonus=0.01)
    calls: list[int] = []
    losses = Appo._minibatch_losses
    monkeypatch.setattr(Appo, "_minibatch_losses", lambda *arguments: calls.append(1) or losses(*arguments))
    made: list[Tensor] = []
    for is_recorded in (False, True):
        torch.manual_seed(4)
        network = ActorCritic(PolicySpec.model_validate({"hidden": (8, 8), **policy}), spaces, training=spec)
        network.has_user_modules = not is_recorded  # modules of users are not recorded
        computer = GradientComputer(spec, network, spaces)
        calls.clear()
        for seed in (1, 2):  # the number of valid rows differs, the shapes do not
            for step, terms in enumerate(computer.compute(random_batch(spaces, network.state_size, seed), 0.1 / seed)):
                computer.parameters.values -= 0.01 * computer.parameters.gradients
                made += [computer.parameters.gradients.clone(), torch.stack(terms)]
                assert step < PASSES * MINIBATCHES
        assert len(calls) == (2 if is_recorded else 2 * PASSES * MINIBATCHES)
    half = len(made) // 2
    assert half == 2 * 2 * PASSES * MINIBATCHES
    for expected, recorded in zip(made[:half], made[half:], strict=True):
        assert torch.equal(recorded, expected)


def repeated(
    function: Callable[[Sequence[Tensor]], Sequence[Tensor]], first: Sequence[Tensor], then: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Record a function with some tensors, and repeat it with others."""
    tape, repeat = OperationTape.of(function, first)
    others = tuple(tape.inputs.values())[len(first) :]
    with torch.no_grad():
        return repeat(*then, *others)


STEPS = {
    "split and joined": lambda x, w: torch.cat([part * k for k, part in enumerate(x.split(2, 1), 1)], 1),
    "a view that is written": lambda x, w: (lambda copy: (copy[:, 1].add_(1.0), copy)[1])(x.clone()),
    "transposed": lambda x, w: x.T.contiguous().T,
    "weighted": lambda x, w: (x @ w).tanh(),
    "of the maximum": lambda x, w: x - x.max(1, keepdim=True).values,
    "chosen": lambda x, w: x.gather(1, (x > 0).long()),
    "masked": lambda x, w: x.masked_fill(x < 0, 0.5),
    "expanded": lambda x, w: x + x.mean(0).expand(x.shape),
    "with a new tensor": lambda x, w: x + torch.arange(4.0) * torch.tensor(0.5),
    "unused": lambda x, w: (x.sum(), x.detach(), x)[2],
}


@given(st.lists(st.sampled_from(list(STEPS)), min_size=1, max_size=8), st.integers(0, 2**31))
def test_repeated_operations_and_their_gradients_are_those_of_the_function(names: list[str], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    flat = torch.randn(40, generator=generator)
    weights = flat[8:24].view(4, 4).requires_grad_()  # a part of a larger tensor, as the parameters of a network are

    def function(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
        values = tensors[0] @ weights
        for name in names:
            values = STEPS[name](values, weights)
        loss = (values * tensors[1]).square().mean()
        return loss.detach(), *torch.autograd.grad(loss, weights)

    first, then = ([torch.randn(3, 4, generator=generator), torch.randn(4, generator=generator)] for _ in range(2))
    expected = function(then)
    for result, wanted in zip(repeated(function, first, then), expected, strict=True):
        assert not result.requires_grad
        torch.testing.assert_close(result, wanted, rtol=0, atol=0, equal_nan=True)


def test_values_of_parameters_are_those_of_the_moment() -> None:
    weights = torch.ones(3)
    tape, repeat = OperationTape.of(lambda tensors: [tensors[0] * weights], [torch.ones(3)])
    weights.mul_(5.0)
    assert torch.equal(repeat(torch.full((3,), 2.0), *list(tape.inputs.values())[1:])[0], torch.full((3,), 10.0))


def test_function_that_reads_a_value_is_refused() -> None:
    with pytest.raises(TapeError, match="depend on values"):
        OperationTape.of(lambda tensors: [tensors[0] * float(tensors[0].sum())], [torch.ones(3)])


def test_part_of_an_argument_that_was_taken_before_is_refused() -> None:
    whole = torch.ones(4)
    part = whole[1:3]  # the recording could not know that it changes with the argument
    with pytest.raises(TapeError, match="part of a tensor"):
        OperationTape.of(lambda tensors: [tensors[0].sum() + part], [whole])


def test_recording_does_not_import_the_compiler_of_torch() -> None:
    program = """
import sys, torch
from daedalus.algorithms.recording import OperationRecorder
recorder, weight = OperationRecorder(), torch.ones(3, requires_grad=True)
def gradient(tensors):
    return torch.autograd.grad((tensors[0] * weight).tanh().square().sum(), weight)
for _ in range(30):
    recorder.call("gradient", gradient, [torch.ones(3)])
assert recorder._recordings
print([name for name in ("torch._dynamo", "torch._inductor", "sympy") if name in sys.modules])
"""
    made = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert made.stdout.strip() == "[]", made.stderr
