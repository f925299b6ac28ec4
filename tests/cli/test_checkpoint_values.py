"""Value estimates for the camera: by the newest checkpoint of a run directory."""

from pathlib import Path

import numpy as np
import pytest
import torch
from saved_runs import CARTPOLE, save

from daedalus.launch.camera_process import CheckpointValues
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.policy.user_modules import NO_MODULES

OBSERVATION = {"observation": np.array([[0.1, -0.2, 0.3, 0.4]], np.float32)}


def state_of(size: int) -> np.ndarray:
    return np.full((1, size), 0.5, np.float32)


@pytest.mark.parametrize(
    "policy",
    [
        {},
        {"separate_value_encoder": True},
        {"memory": "gru", "memory_units": 8},
        {"normalize_observations": True},
    ],
)
def test_value_is_that_of_the_network(tmp_path: Path, policy: dict[str, object]) -> None:
    run = save(tmp_path / "run", CARTPOLE, 3, policy={"hidden": (16,), **policy})
    values = CheckpointValues(run, NO_MODULES)
    saved = read_policy(checkpoints(run)[0])
    network = ActorCritic(saved.spec.policy, saved.spaces, training=saved.spec.training)
    network.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in saved.weights.items()})
    state = state_of(network.state_size)
    assert values(OBSERVATION, state) is None
    values.refresh()
    rows = {name: torch.from_numpy(array)[None] for name, array in OBSERVATION.items()}
    with torch.no_grad():
        _, expected = network(rows, torch.from_numpy(state), torch.zeros((1, 1), dtype=torch.bool))
    assert values(OBSERVATION, state) == pytest.approx(float(expected))


def test_value_of_action_values_is_that_of_the_best_action(tmp_path: Path) -> None:
    run = save(tmp_path / "run", CARTPOLE, 3, training={"algorithm": "one_step_q"})
    values = CheckpointValues(run, NO_MODULES)
    values.refresh()
    saved = read_policy(checkpoints(run)[0])
    network = ActorCritic(saved.spec.policy, saved.spaces, training=saved.spec.training)
    network.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in saved.weights.items()})
    with torch.no_grad():
        outputs, _ = network.step(
            {name: torch.from_numpy(array) for name, array in OBSERVATION.items()}, torch.zeros(1, 0)
        )
    assert values(OBSERVATION, state_of(0)) == pytest.approx(float(outputs.max()))


def test_the_outputs_of_a_policy_without_values_are_no_values(tmp_path: Path) -> None:
    squashed = {"distribution": "squashed_gaussian", "state_dependent_std": True}
    values = CheckpointValues(save(tmp_path, CARTPOLE, 3, policy=squashed, training={"algorithm": "sac"}), NO_MODULES)
    values.refresh()
    assert values(OBSERVATION, state_of(0)) is None


def test_a_newer_checkpoint_is_used_and_a_damaged_one_is_not(tmp_path: Path) -> None:
    run = save(tmp_path / "run", CARTPOLE, 3, weights_seed=1)
    values = CheckpointValues(run, NO_MODULES)
    values.refresh()
    first = values(OBSERVATION, state_of(0))
    save(run, CARTPOLE, 4, weights_seed=2)
    values.refresh()
    second = values(OBSERVATION, state_of(0))
    assert second != first
    save(run, CARTPOLE, 5, weights_seed=3)
    (checkpoints(run)[0] / "parameters.safetensors").write_bytes(b"damaged")
    values.refresh()
    assert values(OBSERVATION, state_of(0)) == second


def test_a_run_without_checkpoints_has_no_values(tmp_path: Path) -> None:
    values = CheckpointValues(tmp_path, NO_MODULES)
    values.refresh()
    assert values(OBSERVATION, state_of(0)) is None
