"""algorithms/recording.py: the operations of a function are repeated with other tensors, or it says why not."""

import subprocess
import sys
from collections.abc import Callable, Sequence

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from daedalus.algorithms.recording import OperationTape, TapeError


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
recorder = OperationRecorder()
for _ in range(30):
    recorder.call("sum", lambda tensors: (tensors[0].sum(),), [torch.ones(3)])
assert recorder._recordings
print([name for name in ("torch._dynamo", "torch._inductor", "sympy") if name in sys.modules])
"""
    made = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert made.stdout.strip() == "[]", made.stderr
