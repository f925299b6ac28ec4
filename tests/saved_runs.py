"""Run directories with checkpoints, as a learner saves them."""

from pathlib import Path
from typing import Any

import numpy as np
from allowed_modules import TEST_MODULES

from daedalus.actor.environments.make import make_environments
from daedalus.learner.training.checkpoint import encode_checkpoint, save_checkpoint
from daedalus.learner.training.learner import Learner
from daedalus.policy.saving.best_checkpoints import best_name
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

COUNTING = EnvironmentSpec(id="counting_environment:Counting-v0", frame_stack=4)
CARTPOLE = EnvironmentSpec(id="CartPole-v1")
RACING = EnvironmentSpec(
    id="CarRacing-v3",
    max_episode_steps=10,
    action_table=((0.0, 1.0, 0.0), (1.0, 0.5, 0.0)),
    action_repeat=4,
    crop=(0, 12, 6, 6),
    grey=True,
    resize=(21, 21),
    frame_stack=4,
)

_programs: dict[tuple[str, ...], bytes] = {}  # those that were exported, by what they depend on


def save(
    run: Path,
    environment: EnvironmentSpec,
    *versions: int,
    spaces: Spaces | None = None,
    weights_seed: int = 5,
    gain: float | None = None,
    **spec: Any,
) -> Path:
    """Save a run with checkpoints of one untrained policy that takes all actions; return the run directory.

    `gain`: deviation of the outputs of each layer; None: weights near 1, which saturate large networks.
    """
    if spaces is None:
        made = make_environments(environment, 1, modules=TEST_MODULES)
        made.close()
        spaces = made.spaces
    run_spec = RunSpec.model_validate({"policy": {"hidden": (16,)}, **spec, "environment": environment})
    learner = Learner(run_spec.training, run_spec.policy, spaces)
    random = np.random.default_rng(weights_seed)
    weights = {name: random.standard_normal(array.shape, np.float32) for name, array in learner.weights().items()}
    if gain is not None:
        weights = {name: gain * array / np.float32(max(4, array[0].size)) ** 0.5 for name, array in weights.items()}
        weights["policy_head.bias"] *= 0.0  # so that actions depend on the observation
        weights["policy_head.weight"] -= weights["policy_head.weight"].mean(1, keepdims=True)
    architecture = (*(part.model_dump_json() for part in (run_spec.training, run_spec.policy, spaces)),)
    if architecture not in _programs:
        _programs[architecture] = learner.program()
    for version in versions:
        encoded = encode_checkpoint(
            spec=run_spec,
            spaces=spaces,
            policy_version=version,
            program=_programs[architecture],
            parameters=weights,
            state=learner.state(),
            counters={},
        )
        save_checkpoint(run, encoded, keep=9)
    return run


def score(run: Path, score: float, version: int, *, training: bool = False) -> Path:
    """Rename a checkpoint as an evaluation with this score does, or the `training` episodes; return its folder."""
    directory = run / "checkpoints" / f"{version:010d}"
    return directory.rename(directory.with_name(best_name(score, version, training=training)))
