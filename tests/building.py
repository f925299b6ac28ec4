"""Builders for tests of the learner: small specifications, rollouts, batches, fleets."""

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plain import vector_spaces

from daedalus.algorithms.batch import Batch, BatchAssembler
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.run_context import RunContext
from daedalus.protocol.messages import Join
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, RunSpec, TrainingSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

EPOCH = 77
ROWS, ENVIRONMENTS = 6, 3
SPACES = vector_spaces(3, 4)
POLICY = PolicySpec(hidden=(8,))
RECURRENT = PolicySpec(hidden=(8,), memory="gru", memory_units=5)


def run_spec(rows: int = ROWS, actors: int = 2, **training: Any) -> RunSpec:
    return RunSpec.model_validate(
        {
            "environment": EnvironmentSpec(id="Any-v0"),
            "policy": POLICY,
            "collection": {"rollout_length": rows, "actors": actors, "envs_per_actor": ENVIRONMENTS},
            "training": TrainingSpec.model_validate(training),
        }
    )


def identity(actor: str = "a", sequence: int = 0, incarnation: int = 1, epoch: int = EPOCH) -> RolloutIdentity:
    return RolloutIdentity(actor=actor, incarnation=incarnation, sequence=sequence, learner_epoch=epoch)


def make_rollout(
    rollout_identity: RolloutIdentity | None = None,
    *,
    version: int = 0,
    rows: int = ROWS,
    environments: int = ENVIRONMENTS,
    shape: Sequence[int] = (3,),
    stack: int = 1,
    state_size: int = 0,
    seed: int = 0,
    **replaced: Any,
) -> Rollout:
    """Return a rollout with random content: terminations, truncations and the reset rows after them.

    `frames` and `actions` [T, E] may be arrays: they are then the only component.
    """
    random = np.random.default_rng(seed)
    terminated, truncated = np.zeros((2, rows, environments), np.bool_)
    valid = np.ones((rows, environments), np.bool_)
    valid[0] = random.random(environments) > 0.3
    for row in range(rows):
        if row:
            valid[row] = ~(terminated[row - 1] | truncated[row - 1])
        terminated[row] = valid[row] & (random.random(environments) < 0.15)
        truncated[row] = valid[row] & (random.random(environments) < 0.15)
    cells = (rows, environments)
    ends = int(np.count_nonzero(terminated | truncated))
    content: dict[str, Any] = {
        "frames": {"observation": random.standard_normal((stack + rows, environments, *shape), np.float32)},
        "initial_state": np.tanh(random.standard_normal((environments, state_size), np.float32)),
        "actions": {"action": random.integers(0, 4, (*cells, 1), np.uint8)},
        "masks": {},
        "behaviour_log_probs": -random.uniform(0.5, 2.5, cells).astype(np.float32),
        "rewards": random.standard_normal(cells, np.float32),
        "terminated": terminated,
        "truncated": truncated,
        "valid": valid,
        "episode_returns": np.full(ends, -1.5, np.float32),
        "episode_lengths": np.full(ends, 1, np.int32),
    }
    if isinstance(replaced.get("frames"), np.ndarray):
        replaced["frames"] = {"observation": replaced["frames"]}
    if isinstance(replaced.get("actions"), np.ndarray):
        replaced["actions"] = {"action": replaced["actions"][..., None]}
    return Rollout(identity=rollout_identity or identity(), policy_version=version, **{**content, **replaced})


def make_rollouts(seed: int, count: int = 2, state_size: int = 0) -> list[Rollout]:
    """Return the rollouts of one batch."""
    return [make_rollout(seed=seed * 100 + number, state_size=state_size) for number in range(count)]


def join(rollouts: Sequence[Rollout], spaces: Spaces = SPACES) -> Batch:
    """Return a batch of rollouts in new memory."""
    device = torch.device("cpu")
    return BatchAssembler(spaces, device).join(rollouts).to(device)


def joined_fleet(*actors: str, environments: int = ENVIRONMENTS, spaces: Spaces = SPACES, seed: int = 1) -> Fleet:
    """Return a fleet in which incarnation 1 of each named actor has joined and is present."""
    fleet = Fleet(seed, None, expected_environments=environments)
    for actor in actors:
        assert fleet.join(Join(actor=actor, incarnation=1, spaces=spaces, environments=environments), 0.0) is None
        fleet.set_present(actor, 1, True, 0.0)
    return fleet


def run_context(
    spec: RunSpec | None = None, directory: Path = Path("r"), *, spaces: Spaces | None = SPACES, **replaced: Any
) -> RunContext:
    """Return the context of a new run, with `EPOCH` and other parts if they are given."""
    context = RunContext.begin(directory, spec or run_spec(), threading.Event(), spaces=spaces)
    return replace(context, **{"learner_epoch": EPOCH, **replaced})
