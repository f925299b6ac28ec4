"""Joining the rollouts of several agents, all of one policy version, into one rollout."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from daedalus.protocol.uploads import Rollout


def side_by_side(rollouts: Sequence[Rollout]) -> Rollout:
    """Return a rollout whose environments are those of the given ones, in their order.

    All have the same T, the same spaces and the same policy version; the identity is that of the first. Their
    `episode_info` must be empty: it is that of environments which an actor steps.
    """
    first, *others = rollouts
    if not others:
        return first
    overridden = [np.zeros_like(each.valid) if each.overridden is None else each.overridden for each in rollouts]
    return replace(
        first,
        frames=_joined([each.frames for each in rollouts]),
        initial_state=np.concatenate([each.initial_state for each in rollouts]),
        actions=_joined([each.actions for each in rollouts]),
        masks=_joined([each.masks for each in rollouts]),
        behaviour_log_probs=np.concatenate([each.behaviour_log_probs for each in rollouts], axis=1),
        rewards=np.concatenate([each.rewards for each in rollouts], axis=1),
        terminated=np.concatenate([each.terminated for each in rollouts], axis=1),
        truncated=np.concatenate([each.truncated for each in rollouts], axis=1),
        valid=np.concatenate([each.valid for each in rollouts], axis=1),
        episode_returns=np.concatenate([each.episode_returns for each in rollouts]),
        episode_lengths=np.concatenate([each.episode_lengths for each in rollouts]),
        overridden=np.concatenate(overridden, axis=1) if any(each.any() for each in overridden) else None,
    )


def _joined(arrays: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([each[name] for each in arrays], axis=1) for name in arrays[0]}
