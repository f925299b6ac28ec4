"""algorithms/batch.py: rollouts joined on the environment axis, in reused memory."""

from typing import Any

import numpy as np
import pytest
import torch
from building import ENVIRONMENTS, ROWS, SPACES, identity, join, make_rollout
from plain import ACTION, NAME, array_space, plain_spaces

from daedalus.algorithms.batch import Batch, BatchAssembler
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
        assert_holds(batch, rollouts, array_space(spaces).frames)
        copied = [getattr(batch, name) for name in ("starts", *COPIED)]
        places.add(tuple(part.data_ptr() for part in (batch.observations[NAME], batch.actions[ACTION], *copied)))
    assert len(places) == 1


def test_batches_of_different_sizes_are_assembled_correctly() -> None:
    assembler = BatchAssembler(PIXEL_SPACES, CPU)
    for environments in (3, 5, 1, 3):
        rollouts = [pixels(environments, environments), pixels(7)]
        assert_holds(assembler.join(rollouts), rollouts, depth=4)


def test_batch_dtypes() -> None:
    batch = join([make_rollout()])
    assert batch.actions[ACTION].dtype == torch.int64
    assert batch.valid.dtype == batch.initial_state.dtype == torch.float32
    assert batch.terminated.dtype == batch.truncated.dtype == batch.starts.dtype == torch.bool
    assert batch.observations[NAME].dtype == batch.rewards.dtype == torch.float32


def test_pixel_observations_stay_uint8() -> None:
    assert join([pixels(1)], PIXEL_SPACES).observations[NAME].dtype == torch.uint8


def test_batch_is_a_copy_of_its_rollouts() -> None:
    rollout = make_rollout()
    batch = join([rollout])
    before = batch.rewards.clone()
    rollout.rewards[:] = 5.0
    assert torch.equal(batch.rewards, before)
