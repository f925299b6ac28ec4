"""Plays whole episodes with a saved policy and reports their returns. Contributes nothing to training."""

from dataclasses import dataclass

import numpy as np

from actor.collector import EpisodeCounter
from actor.environments import VectorEnvironment
from policy.runtime import PolicyRuntime

_MOST_ENVIRONMENTS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The episodes played, in no particular order."""

    returns: np.ndarray  # [episodes] float32, undiscounted and unscaled
    lengths: np.ndarray  # [episodes] int32


def environments_for(episodes: int) -> int:
    """How many environments to play so many episodes in."""
    return min(episodes, _MOST_ENVIRONMENTS)


def play_episodes(
    runtime: PolicyRuntime,
    environments: VectorEnvironment,
    episodes: int,
    seed: int,
    *,
    sampled: bool,
) -> Evaluation:
    """Plays `episodes` episodes, greedily unless `sampled`.

    Each environment has its share and what it plays beyond that is not counted: taking whichever episodes end
    first would favour the short ones.
    """
    count = environments.count
    share = np.full(count, episodes // count)
    share[: episodes % count] += 1
    environment_seed, action_seed = np.random.SeedSequence(seed).generate_state(2)
    random = np.random.default_rng(action_seed) if sampled else None
    counter = EpisodeCounter(count)
    returns: list[np.ndarray] = []
    lengths: list[np.ndarray] = []
    spaces = environments.spaces
    observations = np.ascontiguousarray(environments.reset(int(environment_seed)), spaces.observation.dtype)
    while share.any():
        actions, _ = runtime.act(observations, random)
        stepped, rewards, terminated, truncated = environments.step(actions)
        observations = np.ascontiguousarray(stepped, spaces.observation.dtype)
        ended = terminated | truncated
        counter.step(rewards, terminated, truncated)
        if ended.any():
            finished = counter.take_finished()
            counted = share[ended] > 0
            returns.append(finished.returns[counted])
            lengths.append(finished.lengths[counted])
            share[ended] = np.maximum(share[ended] - 1, 0)
    return Evaluation(returns=np.concatenate(returns), lengths=np.concatenate(lengths))
