"""Tasks and variants of the studies, and their settings."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import benchmarks.study.catch  # noqa: F401 - registers Catch-v0
from daedalus.learner.run.settings import choose_algorithm, read_preset, run_spec
from daedalus.protocol.spec import RunSpec

_CATCH: dict[str, Any] = {
    "environment": {"id": "Catch-v0"},
    "policy": {"encoder": "small"},
    "collection": {"actors": 1, "envs_per_actor": 32, "rollout_length": 20},
    "training": {
        "discount_factor": 0.99,
        "trace_lambda": 0.95,
        "learning_rate": 3e-3,
        "learning_rate_final": 3e-4,
        "entropy_bonus": 0.01,
        "entropy_bonus_final": 0.0,
    },
}

# Short rollouts, unlike the preset's: a3c and impala make one update of each, and hardly learn with few updates.
_LUNAR_LANDER: dict[str, Any] = {
    "environment": {"id": "LunarLander-v3", "reward_scale": 0.05},
    "collection": {"actors": 1, "envs_per_actor": 16, "rollout_length": 20},
    "training": {
        "discount_factor": 0.99,
        "trace_lambda": 0.95,
        "learning_rate": 1e-3,
        "entropy_bonus": 0.01,
        "entropy_bonus_final": 0.0,
        "normalize_advantages": True,
    },
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """An environment with its budget and the returns that scale its results."""

    settings: Mapping[str, Any] | str  # or the name of a preset
    env_steps: int
    threshold: float  # mean return of the last 100 training episodes
    random_return: float  # mean return of random actions


TASKS = {
    "cartpole": Task(settings="cartpole", env_steps=500_000, threshold=475.0, random_return=22.0),
    "lunar_lander": Task(settings=_LUNAR_LANDER, env_steps=300_000, threshold=200.0, random_return=-180.0),
    "catch": Task(settings=_CATCH, env_steps=400_000, threshold=0.9, random_return=-0.7),
}

# Algorithm and upload.
VARIANTS = {
    "a3c rollouts": ("a3c", "rollouts"),
    "a3c gradients": ("a3c", "gradients"),
    "impala": ("impala", "rollouts"),
    "appo": ("appo", "rollouts"),
}


def specification(task: str, variant: str, seed: int, env_steps: int) -> RunSpec:
    """Return the settings of a run; the whole budget is used, also after the threshold."""
    chosen, (algorithm, upload) = TASKS[task], VARIANTS[variant]
    settings = (
        read_preset(chosen.settings) if isinstance(chosen.settings, str) else copy.deepcopy(dict(chosen.settings))
    )
    choose_algorithm(settings, algorithm)
    settings["collection"]["upload"] = upload
    settings["training"] |= {
        "seed": seed,
        "env_steps": env_steps,
        "target_return": chosen.threshold,
        "target_episodes": 100,
        "stop_when_solved": False,
        "batch_rollouts": 1,
    }
    return run_spec(settings)
