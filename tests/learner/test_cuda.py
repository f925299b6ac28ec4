"""The learner on CUDA against the learner on the CPU. Skipped without a CUDA device."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from building import ENVIRONMENTS, ROWS, SPACES, make_rollout, run_spec
from plain import NAME, act, array_space

from daedalus.algorithms.replay_buffer import ReplayBuffer
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.training.checkpoint import encode_checkpoint, load_checkpoint, save_checkpoint
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")

IMAGES = Spaces(
    observations={"observation": ArraySpace(shape=(42, 42), dtype="uint8", frames=4)},
    actions={"action": SPACES.actions["action"]},
)
KINDS: dict[str, tuple[PolicySpec, Spaces]] = {
    "mlp": (PolicySpec(hidden=(8,)), SPACES),
    "normalized": (PolicySpec(hidden=(8,), normalize_observations=True), SPACES),
    "gru": (PolicySpec(hidden=(8,), memory="gru", memory_units=5), SPACES),
    "small": (PolicySpec(encoder="small"), IMAGES),
    "article, gru": (PolicySpec(encoder="article", memory="gru", memory_units=5), IMAGES),
}


def learner(device: str, policy: PolicySpec, spaces: Spaces, **training: Any) -> Learner:
    settings = {"device": device, "precision": "float32", "learning_rate": 1e-3, **training}
    return Learner(TrainingSpec.model_validate(settings), policy, spaces)


def rollouts(seed: int, spaces: Spaces, state_size: int) -> list[Rollout]:
    space = array_space(spaces)
    made = [make_rollout(seed=100 * seed + number, state_size=state_size) for number in range(2)]
    if space.dtype != "uint8":
        return made
    random = np.random.default_rng(seed)
    shape = (space.frames + ROWS, ENVIRONMENTS, *space.shape)
    return [replace(rollout, frames={NAME: random.integers(0, 256, shape, np.uint8)}) for rollout in made]


def trained_learner(device: str, policy: PolicySpec, spaces: Spaces, **training: Any) -> Learner:
    """Return a learner after as many batches as it takes to record a CUDA graph, and some more."""
    trained = learner(device, policy, spaces, **training)  # seeds the order of minibatches
    for step in range(12):
        made = rollouts(step, spaces, trained.state_size)
        if step == 10 and training["algorithm"] != "appo":  # a repeated batch of appo has other minibatches
            made[1] = replace(made[1], rewards=np.full_like(made[1].rewards, np.inf))
        trained.step(made, progress=0.0)
    trained.finish()
    return trained


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("algorithm", ["a2c", "impala", "appo"])
def test_updates_on_cuda_equal_updates_on_cpu(algorithm: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    policy, spaces = KINDS[kind]
    start = {name: array.copy() for name, array in learner("cpu", policy, spaces).weights().items()}
    # Few and small updates: differences of rounding grow with each.
    settings = {"algorithm": algorithm, "passes": 2, "minibatches": 2, "learning_rate": 1e-4}
    there, here = (trained_learner(device, policy, spaces, **settings) for device in ("cuda", "cpu"))
    assert there.graphs.is_enabled
    assert (there.policy_version, there.updates_skipped) == (here.policy_version, here.updates_skipped)
    for name, expected in here.weights().items():
        moved = np.abs(expected - start[name]).max()
        np.testing.assert_allclose(there.weights()[name], expected, atol=0.05 * moved + 1e-6, err_msg=name)
    assert there.metrics.take_means() == pytest.approx(here.metrics.take_means(), rel=0.02, abs=1e-3)
    assert there.metrics.take_action_counts() == here.metrics.take_action_counts()


def test_program_and_checkpoints_from_cuda_work_on_cpu(tmp_path: Path) -> None:
    policy, spaces = KINDS["small"]
    there = learner("cuda", policy, spaces)
    there.step(rollouts(1, spaces, 0), progress=0.0)
    runtime = OnnxRuntime(there.program())
    runtime.load({name: array.copy() for name, array in there.weights().items()})
    observations = np.random.default_rng(1).integers(0, 256, (5, *array_space(spaces).stacked_shape), np.uint8)
    actions, _, _ = act(runtime, observations, np.zeros((5, 0), np.float32))
    assert actions.shape == (5,)
    encoded = encode_checkpoint(
        spec=run_spec(),
        spaces=spaces,
        policy_version=there.policy_version,
        program=there.program(),
        parameters=there.weights(),
        state=there.state(),
        counters=RunCounters(1).state(0.0),
    )
    directory = save_checkpoint(tmp_path, encoded, keep=1)
    checkpoint = load_checkpoint(directory)
    here = learner("cpu", policy, spaces)
    here.restore(checkpoint.policy.policy_version, checkpoint.policy.weights, checkpoint.state)
    for name, expected in there.weights().items():
        np.testing.assert_array_equal(here.weights()[name], expected)


def test_mixed_precision_changes_all_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, spaces = KINDS["small"]
    there = learner("cuda", policy, spaces, algorithm="appo", precision="bfloat16")
    start = {name: array.copy() for name, array in there.weights().items()}
    there.step(rollouts(1, spaces, 0), progress=0.0)
    assert there.updates_skipped == 0
    for name, array in there.weights().items():
        assert np.isfinite(array).all()
        assert not np.array_equal(array, start[name]), name


def test_a_replay_buffer_on_cuda_samples_what_one_in_main_memory_does() -> None:
    here, there = (ReplayBuffer(IMAGES, ROWS, 8 * ROWS, device) for device in ("cpu", "cuda"))
    for seed in range(6):
        for rollout in rollouts(seed, IMAGES, 0):
            here.add(rollout)
            there.add(rollout)
    assert there.nbytes < here.nbytes
    rows = here.learned_rows
    expected, found = (buffer.transitions(rows, 3, 0.9) for buffer in (here, there))
    assert found.observations[NAME].device.type == "cuda"
    for mine, theirs in zip((expected.observations, expected.next_observations), found[:2], strict=True):
        torch.testing.assert_close(theirs[NAME].cpu(), mine[NAME])
    for name, values in there.copied(4, 8).items():
        np.testing.assert_array_equal(values, here.copied(4, 8)[name])
