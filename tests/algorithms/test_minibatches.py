"""algorithms/minibatches.py: a pass over a batch takes every valid row once, cut where it may be."""

from dataclasses import dataclass

import pytest
import torch
from building import ENVIRONMENTS, ROWS, join, make_rollouts
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.minibatches import Minibatch, minibatches
from daedalus.algorithms.returns import Targets

WIDTH = 2 * ENVIRONMENTS


@dataclass(frozen=True)
class Numbered:
    """A batch whose log-probabilities number its rows, so that a sample says where each of its rows is from."""

    batch: Batch
    numbers: Tensor  # [T, B]
    targets: Targets

    def pass_of(self, count: int) -> list[Minibatch]:
        return list(minibatches(self.batch, self.numbers, self.targets, count))

    def assert_holds(self, sample: Minibatch) -> None:
        """Every row of a sample is the batch's row of that number."""
        for row, column in torch.cartesian_prod(*map(torch.arange, sample.log_probs.shape)).tolist():
            t, b = divmod(int(sample.log_probs[row, column]), WIDTH)
            assert torch.equal(sample.observations[row, column], self.batch.observations[t, b])
            for name in ("starts", "actions", "valid"):
                assert torch.equal(getattr(sample, name)[row, column], getattr(self.batch, name)[t, b])
            assert torch.equal(sample.targets[row, column], self.targets.values[t, b])
            assert torch.equal(sample.advantages[row, column], self.targets.advantages[t, b])
            assert torch.equal(sample.weights[row, column], self.targets.weights[t, b])


def numbered(state_size: int) -> Numbered:
    torch.manual_seed(3)
    batch = join(make_rollouts(1, state_size=state_size))
    assert not batch.valid.all()
    numbers = torch.arange(ROWS * WIDTH, dtype=torch.float32).reshape(ROWS, WIDTH)
    return Numbered(
        batch, numbers, Targets(torch.randn(ROWS, WIDTH), torch.randn(ROWS, WIDTH), torch.rand(ROWS, WIDTH))
    )


COUNTS = [1, 2, 3, 4, 7, ROWS * WIDTH, ROWS * WIDTH + 5]


@pytest.mark.parametrize("count", COUNTS)
def test_pass_without_memory_contains_each_valid_row_once(count: int) -> None:
    made = numbered(state_size=0)
    samples = made.pass_of(count)
    assert len(samples) == min(count, int(made.batch.valid.sum()))
    assert all(sample.actions.numel() for sample in samples)
    sizes = [sample.actions.numel() for sample in samples]
    assert max(sizes) - min(sizes) <= 1
    taken = torch.cat([sample.log_probs.flatten() for sample in samples])
    expected = made.numbers[made.batch.valid == 1.0]
    assert torch.equal(taken.sort().values, expected)
    for sample in samples:
        assert len(sample.actions) == 1
        assert sample.initial_state.shape == (sample.actions.shape[1], 0)
        made.assert_holds(sample)


@pytest.mark.parametrize("count", [1, 2, 3, 4, WIDTH, WIDTH + 5])
def test_pass_with_memory_contains_each_environment_once_with_all_rows(count: int) -> None:
    made = numbered(state_size=5)
    samples = made.pass_of(count)
    assert len(samples) == min(count, WIDTH)
    widths = [sample.actions.shape[1] for sample in samples]
    assert max(widths) - min(widths) <= 1
    taken = torch.cat([sample.log_probs for sample in samples], dim=1)  # [T, B] in another order of columns
    columns = taken[0].long()
    assert columns.sort().values.tolist() == list(range(WIDTH))
    assert torch.equal(taken, made.numbers[:, columns])
    for sample in samples:
        made.assert_holds(sample)
        assert torch.equal(sample.initial_state, made.batch.initial_state[sample.log_probs[0].long()])


@pytest.mark.parametrize("state_size", [0, 5])
def test_each_pass_has_a_new_order(state_size: int) -> None:
    made = numbered(state_size)
    orders = {tuple(made.pass_of(1)[0].log_probs.flatten().tolist()) for _ in range(5)}
    assert len(orders) > 1
