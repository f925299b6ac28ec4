"""Plays whole episodes with a policy and reports their returns. Contributes nothing to training."""

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from daedalus.actor.collecting.episode_counter import EpisodeCounter
from daedalus.actor.environments.interface import VectorEnvironment
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.frames import FrameStack
from daedalus.protocol.spec import EnvironmentSpec

_MOST_ENVIRONMENTS = 100
_ENVIRONMENTS_PER_PROCESSOR = 4  # where each is a process: enough to keep a processor busy, few enough to start


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The episodes played, in no particular order."""

    returns: np.ndarray  # [episodes] float32, undiscounted and unscaled
    lengths: np.ndarray  # [episodes] int32, env_steps


def environments_for(episodes: int, spec: EnvironmentSpec | None = None) -> int:
    """How many environments to play so many episodes in."""
    most = _MOST_ENVIRONMENTS
    if spec is not None and spec.processes and spec.backend == "gymnasium":
        most = _ENVIRONMENTS_PER_PROCESSOR * (os.cpu_count() or 1)
    return min(episodes, most)


def _silent(finished: int, mean: float) -> None:
    pass


def play_episodes(
    runtime: PolicyRuntime,
    environments: VectorEnvironment,
    episodes: int,
    seed: int,
    *,
    sampled: bool,
    progress: Callable[[int, float], None] = _silent,
) -> Evaluation:
    """Plays `episodes` episodes, greedily unless `sampled`.

    Each environment has its share and what it plays beyond that is not counted: taking whichever episodes end
    first would favour the short ones. After every step `progress` is told how many have been counted, and their mean
    return (NaN before the first).
    """
    count = environments.count
    share = np.full(count, episodes // count)
    share[: episodes % count] += 1
    environment_seed, action_seed = np.random.SeedSequence(seed).generate_state(2)
    random = np.random.default_rng(action_seed) if sampled else None
    counter = EpisodeCounter(count)
    returns, lengths = np.zeros(0, np.float32), np.zeros(0, np.int32)
    mean = float("nan")
    stack = FrameStack(environments.spaces.observation, count)
    state = np.zeros((count, runtime.state_size), np.float32)
    stack.push(environments.reset(int(environment_seed)), np.ones(count, np.bool_))
    while share.any():
        valid = counter.valid
        actions, _, next_state = runtime.act(stack.observations, state, random)
        frames, rewards, terminated, truncated = environments.step(actions)
        # As the collector does: nothing from before an episode's first row is seen or remembered in it.
        stack.push(frames, ~valid)
        state = next_state * valid[:, None]
        counter.step(rewards, terminated, truncated)
        ended = terminated | truncated
        if ended.any():
            finished = counter.take_finished()
            counted = share[ended] > 0
            returns = np.concatenate([returns, finished.returns[counted]])
            lengths = np.concatenate([lengths, finished.lengths[counted]])
            share[ended] = np.maximum(share[ended] - 1, 0)
            mean = float(returns.mean(dtype=np.float64)) if len(returns) else mean
        progress(len(returns), mean)
    return Evaluation(returns=returns, lengths=lengths)
