"""Wrappers of gymnasium that keep statistics, which a run does not save. Pure functions."""

import gymnasium
from gymnasium.wrappers import NormalizeObservation, NormalizeReward


def unsaved_statistics(environment: gymnasium.Env) -> tuple[str, ...]:
    """Return a warning for each wrapper of an environment that normalises by statistics of its own."""
    warnings: list[str] = []
    while isinstance(environment, gymnasium.Wrapper):
        if isinstance(environment, NormalizeObservation | NormalizeReward) and environment.update_running_mean:
            name = type(environment).__name__
            setting = "policy.normalize_observations"
            if isinstance(environment, NormalizeReward):
                setting = "training.normalize_rewards"
            warnings.append(
                f"wrapper {name} has statistics of its own in each environment, which are not saved: evaluations begin "
                f"without them; use --set {setting}=true in its place"
            )
        environment = environment.env
    return tuple(warnings)
