"""Batches: rollouts side by side, split into minibatches, and played by the network."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from building import ENVIRONMENTS, POLICY, ROWS, SPACES, identity, join, make_rollout, make_rollouts
from plain import ACTION, NAME, array_space, plain_spaces
from torch import Tensor

from daedalus.algorithms.batch import Batch, BatchAssembler
from daedalus.algorithms.forward import FlatParameters, Forward
from daedalus.algorithms.minibatches import Minibatch, draw_pass, minibatches
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.uploads import Rollout

CPU = torch.device("cpu")
COPIED = ("behaviour_log_probs", "rewards", "terminated", "truncated", "valid")
PIXELS = ArraySpace(shape=(2, 3), dtype="uint8", frames=4)
PIXEL_SPACES = plain_spaces(PIXELS, 4)


def pixels(seed: int, environments: int = ENVIRONMENTS, rows: int = ROWS, **replaced: Any) -> Rollout:
    """Return a rollout with stacks of 4 frames, in environment-first memory layout."""
    random = np.random.default_rng(seed)
    frames = random.integers(0, 256, (environments, rows + PIXELS.frames, *PIXELS.shape), np.uint8).swapaxes(0, 1)
    return make_rollout(environments=environments, rows=rows, seed=seed, **{"frames": {NAME: frames}, **replaced})


def stack(rollout: Rollout, row: int, environment: int, depth: int) -> np.ndarray:
    """Return the newest `depth` frames at a row; the first frame of the episode replaces earlier ones.

    Slow reference implementation.
    """
    start = -depth  # the actor prepared the frames before row 0
    for earlier in range(row):
        if not rollout.valid[earlier, environment]:
            start = earlier + 1
    rows = [max(row - age, start) for age in range(depth - 1, -1, -1)]
    return np.stack([rollout.frames[NAME][depth - 1 + each, environment] for each in rows])


def assert_holds(batch: Batch, rollouts: list[Rollout], depth: int) -> None:
    """Assert that every value of a batch equals the value of its rollout."""
    first = 0
    for rollout in rollouts:
        part = slice(first, first + rollout.environments)
        for name in COPIED:
            np.testing.assert_array_equal(getattr(batch, name)[:, part].numpy(), getattr(rollout, name))
        np.testing.assert_array_equal(batch.actions[ACTION][:, part].numpy(), rollout.actions[ACTION])
        np.testing.assert_array_equal(batch.initial_state[part].numpy(), rollout.initial_state)
        assert not batch.starts[0, part].any()
        np.testing.assert_array_equal(batch.starts[1:, part].numpy(), ~rollout.valid)
        for row in range(rollout.rows + 1):
            for environment in range(rollout.environments):
                seen = batch.observations[NAME][row, first + environment].numpy()
                expected = stack(rollout, row, environment, depth)
                np.testing.assert_array_equal(seen, expected if depth > 1 else expected[0])
        first += rollout.environments
    assert batch.actions[ACTION].shape == (rollouts[0].rows, first, 1)


def test_rollouts_are_joined_on_the_environment_axis_in_order() -> None:
    rollouts = [
        make_rollout(identity("b"), seed=1, state_size=5),
        make_rollout(identity("a"), environments=2, seed=2, state_size=5),
        make_rollout(identity("c"), environments=1, seed=3, state_size=5),
    ]
    assert_holds(join(rollouts), rollouts, depth=1)


def test_observations_are_stacked_from_the_frames_of_each_rollout() -> None:
    rollouts = [pixels(1), pixels(2, environments=1), pixels(3, environments=2)]
    assert not all(rollout.valid.all() for rollout in rollouts)
    batch = join(rollouts, PIXEL_SPACES)
    assert batch.observations[NAME].shape == (ROWS + 1, 6, 4, 2, 3)
    assert_holds(batch, rollouts, depth=4)


@pytest.mark.parametrize("rows", [4, 5, 9])
def test_stack_contains_no_frame_of_the_previous_episode(rows: int) -> None:
    for start in range(rows):
        valid = np.ones((rows, 2), np.bool_)
        valid[start, 0] = False
        rollout = pixels(start, environments=2, rows=rows, valid=valid)
        batch = join([rollout], PIXEL_SPACES)
        first = rollout.frames[NAME][PIXELS.frames - 1 + start + 1, 0]
        assert (batch.observations[NAME][start + 1, 0].numpy() == first).all()
        assert_holds(batch, [rollout], depth=4)


@pytest.mark.parametrize(("spaces", "make"), [(SPACES, make_rollout), (PIXEL_SPACES, pixels)])
def test_memory_is_reused_and_completely_overwritten(spaces: Spaces, make: Any) -> None:
    assembler = BatchAssembler(spaces, CPU)
    places = set()
    for seed in range(6):
        rollouts = [make(seed=10 * seed), make(seed=10 * seed + 1)]
        batch = assembler.join(rollouts)
        assert_holds(batch.to(CPU), rollouts, array_space(spaces).frames)
        copied = [getattr(batch, name) for name in ("starts", *COPIED)]
        places.add(tuple(part.data_ptr() for part in (batch.observations[NAME], batch.actions[ACTION], *copied)))
    assert len(places) == 1


def test_batches_of_different_sizes_are_assembled_correctly() -> None:
    assembler = BatchAssembler(PIXEL_SPACES, CPU)
    for environments in (3, 5, 1, 3):
        rollouts = [pixels(environments, environments), pixels(7)]
        assert_holds(assembler.join(rollouts).to(CPU), rollouts, depth=4)


def test_threads_join_as_one_thread_does() -> None:
    rollouts = [pixels(seed, environments=20_000) for seed in range(5)]  # large enough to be copied by threads
    several, one = (BatchAssembler(PIXEL_SPACES, CPU, threads).join(rollouts).to(CPU) for threads in (3, 1))
    for theirs, ours in zip(several.tensors(), one.tensors(), strict=True):
        assert torch.equal(theirs, ours)


def test_batch_dtypes() -> None:
    batch = join([make_rollout()])
    assert batch.actions[ACTION].dtype == torch.int64
    assert batch.valid.dtype == batch.initial_state.dtype == torch.float32
    assert batch.terminated.dtype == batch.truncated.dtype == batch.starts.dtype == torch.bool
    assert batch.observations[NAME].dtype == batch.rewards.dtype == torch.float32
    assert join([pixels(1)], PIXEL_SPACES).observations[NAME].dtype == torch.uint8


def test_batch_is_a_copy_of_its_rollouts() -> None:
    rollout = make_rollout()
    batch = join([rollout])
    before = batch.rewards.clone()
    rollout.rewards[:] = 5.0
    assert torch.equal(batch.rewards, before)


WIDTH = 2 * ENVIRONMENTS


@dataclass(frozen=True)
class Numbered:
    """Batch whose log-probabilities number its rows, so that the rows of a minibatch can be identified."""

    batch: Batch
    numbers: Tensor  # [T, B]
    targets: Tensor  # [T, B]
    factors: Tensor  # [T, B]

    def pass_of(self, count: int) -> list[Minibatch]:
        drawn = draw_pass(self.batch.valid, count, has_memory=self.batch.initial_state.shape[1] > 0)
        of_rows = self.numbers, 10.0 * self.numbers, self.targets, self.factors
        return list(minibatches(self.batch, *of_rows, count, drawn))

    def assert_holds(self, minibatch: Minibatch) -> None:
        """Assert that every row of a minibatch equals the row of the batch with the same number."""
        assert torch.equal(minibatch.values, 10.0 * minibatch.log_probs)
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
    drawn = draw_pass(batch.valid, 4, has_memory=False)
    for minibatch in minibatches(batch, made.numbers, made.numbers, made.targets, made.factors, 4, drawn):
        for column, number in enumerate(minibatch.log_probs[0].int().tolist()):
            t, b = divmod(number, WIDTH)
            assert torch.equal(minibatch.observations[ACTION][0, column], image[t, b])
            assert torch.equal(minibatch.actions[ACTION][0, column], batch.actions[ACTION][t, b])


@pytest.mark.parametrize(("share", "expected"), [(1.0, 4.0), (0.25, 1.0)])
def test_target_network_moves_by_a_share_of_the_way(share: float, expected: float) -> None:
    network = ActorCritic(POLICY, SPACES)
    learned = FlatParameters(network.learned_parameters())
    forward = Forward(network, learned, has_target=True, is_mixed=False)
    before = forward.target_values.clone()
    learned.values.add_(4.0)
    forward.update_target(share)
    torch.testing.assert_close(forward.target_values, before + expected)
    torch.testing.assert_close(
        torch.cat([each.flatten() for each in forward.target_parameters.values()]), before + expected
    )
    torch.testing.assert_close(learned.values, before + 4.0)
