"""Plays an environment by its own vector entry point, as training does. No threads."""

import time

import numpy as np
from gymnasium.vector.utils import batch_space, iterate

from daedalus.actor.checking.random_actions import RandomActions
from daedalus.actor.checking.violations import observation_violations
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import uses_vector_entry_point
from daedalus.actor.environments.interface import BackendEnvironments, Observed
from daedalus.actor.environments.leaves import without
from daedalus.actor.environments.make import make_bare
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.policy.user_code import first_line
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import Spaces, unfit_number
from daedalus.protocol.spec import EnvironmentSpec

_COUNT, _STEPS, _SECONDS = 2, 50, 1.0  # few: one environment was played before


def vectorized_problem(spec: EnvironmentSpec, modules: UserModules, spaces: Spaces, seed: int) -> str:
    """Return what is wrong with the vector entry point, or an empty string, also if training does not use one.

    Args:
      spec: the environment and its transforms.
      modules: the modules that may be imported for it.
      spaces: of one environment that was made without the vector entry point.
      seed: of the environments and the actions.
    """
    try:
        if not uses_vector_entry_point(spec, modules):
            return ""
        bare, rest = make_bare(spec, _COUNT, modules)
        try:
            if problem := _observations_problem(bare, spec, seed):
                return f"environment {spec.id}: {problem} (training uses its vector entry point)"
            environments = TransformedEnvironment(bare, rest)
            if environments.spaces != spaces:
                return (
                    f"environment {spec.id}: its vector entry point has {environments.spaces}, "
                    f"but its entry point has {spaces}"
                )
            random, until = RandomActions(spaces.actions, seed), time.monotonic() + _SECONDS
            observed = environments.reset(seed)
            for _ in range(_STEPS):
                observed, rewards, *_ = environments.step(_chosen(random, observed.masks))
                if problem := _numbers_problem(observed, rewards):
                    return f"environment {spec.id}: step returns {problem} (training uses its vector entry point)"
                if time.monotonic() > until:
                    break
        finally:
            bare.close()
    except EnvironmentSetupError as error:
        return f"{error} (training uses its vector entry point)"
    return ""


def _observations_problem(environments: BackendEnvironments, spec: EnvironmentSpec, seed: int) -> str:
    """Return what makes the first observations differ from their space, or an empty string."""
    space = without(environments.observation_space, spec.leave_out)
    observations = environments.reset(seed)
    try:
        rows = list(iterate(batch_space(environments.observation_space, _COUNT), observations))
    except Exception as error:  # broad: they may be anything
        return f"reset returns observations that are no batch of observation_space ({first_line(error)})"
    if len(rows) != _COUNT:
        return f"reset returns {len(rows)} observations for {_COUNT} environments"
    found = (violation for row in rows for violation in observation_violations(space, row, "reset"))
    return next((text for kind, text in found if kind == "problem"), "")


def _numbers_problem(observed: Observed, rewards: np.ndarray) -> str:
    """Return what the learner would refuse, or an empty string."""
    for name, frames in observed.frames.items():
        if unfit := unfit_number(frames):
            return f"an observation whose component {name!r} {unfit}"
    faulty = ~np.isfinite(rewards)
    return f"the reward {rewards[faulty][0]}: it must be finite" if faulty.any() else ""


def _chosen(random: RandomActions, masks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return an action for each environment, {name: [E, D]}, given the masks {name: [E, choices]}."""
    rows = [random.choose({name: mask[row][None] for name, mask in masks.items()}) for row in range(_COUNT)]
    return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
