"""learner/batch.py: rollouts side by side."""

import numpy as np
import torch
from building import identity, make_rollout

from learner.batch import join_rollouts


def test_rollouts_are_joined_on_the_environment_axis_in_the_order_given() -> None:
    first, second = make_rollout(identity("b"), seed=1), make_rollout(identity("a"), environments=2, seed=2)
    batch = join_rollouts([first, second])
    for name in ("observations", "actions", "behaviour_log_probs", "rewards", "terminated", "truncated", "valid"):
        joined = getattr(batch, name).numpy()
        np.testing.assert_array_equal(joined[:, :3], getattr(first, name))
        np.testing.assert_array_equal(joined[:, 3:], getattr(second, name))


def test_a_batch_has_the_dtypes_that_learning_wants() -> None:
    batch = join_rollouts([make_rollout()])
    assert batch.actions.dtype == torch.int64
    assert batch.valid.dtype == torch.float32
    assert batch.terminated.dtype == batch.truncated.dtype == torch.bool
    assert batch.observations.dtype == batch.rewards.dtype == torch.float32


def test_pixels_stay_bytes() -> None:
    pixels = np.arange(7 * 3 * 4, dtype=np.uint8).reshape(7, 3, 4)
    assert join_rollouts([make_rollout(observations=pixels)]).observations.dtype == torch.uint8


def test_a_batch_is_a_copy_of_its_rollouts() -> None:
    rollout = make_rollout()
    batch = join_rollouts([rollout])
    before = batch.rewards.clone()
    rollout.rewards[:] = 5.0
    assert torch.equal(batch.rewards, before)
