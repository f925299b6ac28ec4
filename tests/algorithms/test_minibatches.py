"""algorithms/minibatches.py: a pass over a batch contains every valid row once."""

from dataclasses import dataclass, replace

import pytest
import torch
from building import ENVIRONMENTS, ROWS, join, make_rollouts
from plain import ACTION, NAME
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.minibatches import Minibatch, minibatches

WIDTH = 2 * ENVIRONMENTS


@dataclass(frozen=True)
class Numbered:
    """Batch whose log-probabilities number its rows, so that the rows of a minibatch can be identified."""

    batch: Batch
    numbers: Tensor  # [T, B]
    targets: Tensor  # [T, B]
    factors: Tensor  # [T, B]

    def pass_of(self, count: int) -> list[Minibatch]:
        return list(minibatches(self.batch, self.numbers, self.targets, self.factors, count))

    def assert_holds(self, minibatch: Minibatch) -> None:
        """Assert that every row of a minibatch equals the row of the batch with the same number."""
        for row, column in torch.cartesian_prod(*map(torch.arange, minibatch.log_probs.shape)).tolist():
            t, b = divmod(int(minibatch.log_probs[row, column]), WIDTH)
            assert torch.equal(minibatch.observations[NAME][row, column], self.batch.observations[NAME][t, b])
            assert torch.equal(minibatch.actions[ACTION][row, column], self.batch.actions[ACTION][t, b])
            assert torch.equal(minibatch.starts[row, column], self.batch.starts[t, b])
            assert self.batch.valid[t, b] or minibatch.shares[row, column] == 0.0
            assert torch.equal(minibatch.targets[row, column], self.targets[t, b])
            assert torch.equal(minibatch.factors[row, column], self.factors[t, b])
        counted = minibatch.shares[minibatch.shares > 0.0]
        torch.testing.assert_close(counted, torch.full_like(counted, 1.0 / len(counted)))


def numbered(state_size: int) -> Numbered:
    torch.manual_seed(3)
    batch = join(make_rollouts(1, state_size=state_size))
    assert not batch.valid.all()
    numbers = torch.arange(ROWS * WIDTH, dtype=torch.float32).reshape(ROWS, WIDTH)
    return Numbered(batch, numbers, torch.randn(ROWS, WIDTH), torch.randn(ROWS, WIDTH))


COUNTS = [1, 2, 3, 4, 7, ROWS * WIDTH, ROWS * WIDTH + 5]


@pytest.mark.parametrize("count", COUNTS)
def test_pass_without_memory_contains_each_valid_row_once(count: int) -> None:
    made = numbered(state_size=0)
    parts = made.pass_of(count)
    assert len(parts) == min(count, int(made.batch.valid.sum()))
    assert all(minibatch.shares.numel() for minibatch in parts)
    assert {minibatch.shares.numel() for minibatch in parts} == {-(-ROWS * WIDTH // len(parts))}
    sizes = [int((minibatch.shares > 0.0).sum()) for minibatch in parts]
    assert max(sizes) - min(sizes) <= 1
    taken = torch.cat([minibatch.log_probs[minibatch.shares > 0.0] for minibatch in parts])
    expected = made.numbers[made.batch.valid == 1.0]
    assert torch.equal(taken.sort().values, expected)
    for minibatch in parts:
        assert len(minibatch.shares) == 1
        assert minibatch.initial_state.shape == (minibatch.shares.shape[1], 0)
        made.assert_holds(minibatch)


@pytest.mark.parametrize("count", [1, 2, 3, 4, WIDTH, WIDTH + 5])
def test_pass_with_memory_contains_each_environment_once_with_all_rows(count: int) -> None:
    made = numbered(state_size=5)
    parts = made.pass_of(count)
    assert len(parts) == min(count, WIDTH)
    widths = [minibatch.shares.shape[1] for minibatch in parts]
    assert max(widths) - min(widths) <= 1
    taken = torch.cat([minibatch.log_probs for minibatch in parts], dim=1)  # [T, B] in another order of columns
    columns = taken[0].long()
    assert columns.sort().values.tolist() == list(range(WIDTH))
    assert torch.equal(taken, made.numbers[:, columns])
    for minibatch in parts:
        made.assert_holds(minibatch)
        assert torch.equal(minibatch.shares > 0.0, made.batch.valid[:, minibatch.log_probs[0].long()] == 1.0)
        assert torch.equal(minibatch.initial_state, made.batch.initial_state[minibatch.log_probs[0].long()])


@pytest.mark.parametrize("state_size", [0, 5])
def test_each_pass_has_a_new_order(state_size: int) -> None:
    made = numbered(state_size)
    orders = {tuple(made.pass_of(1)[0].log_probs.flatten().tolist()) for _ in range(5)}
    assert len(orders) > 1


def test_an_action_may_have_the_name_of_a_large_observation() -> None:
    made = numbered(state_size=0)
    image = torch.randn(ROWS + 1, WIDTH, 40, 40)  # too large to be gathered for a whole pass
    batch = replace(made.batch, observations={ACTION: image})
    for minibatch in minibatches(batch, made.numbers, made.targets, made.factors, 4):
        for column, number in enumerate(minibatch.log_probs[0].int().tolist()):
            t, b = divmod(number, WIDTH)
            assert torch.equal(minibatch.observations[ACTION][0, column], image[t, b])
            assert torch.equal(minibatch.actions[ACTION][0, column], batch.actions[ACTION][t, b])
