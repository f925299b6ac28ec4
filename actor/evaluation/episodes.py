"""Whole episodes played with a policy, and their returns. No network, no threads."""

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from daedalus.actor.collecting.episode_counter import EpisodeCounter, FinishedEpisodes
from daedalus.actor.environments.interface import VectorEnvironment
from daedalus.policy.acting.noise import draw_noise, neutral_noise
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.frames import ObservationStacks
from daedalus.protocol.spec import EnvironmentSpec

_MAX_ENVIRONMENTS = 100
_ENVIRONMENTS_PER_PROCESSOR = 4  # if each is a process: enough to keep a processor busy, and few enough to start fast


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The results of an evaluation's episodes, in no particular order."""

    returns: np.ndarray  # [episodes] float32, undiscounted and unscaled
    lengths: np.ndarray  # [episodes] int32, env_steps


def environments_for(episodes: int, spec: EnvironmentSpec | None = None) -> int:
    """Return how many environments to create for so many episodes."""
    most = _MAX_ENVIRONMENTS
    if spec is not None and spec.processes and spec.backend == "gymnasium":
        most = _ENVIRONMENTS_PER_PROCESSOR * (os.cpu_count() or 1)
    return min(episodes, most)


def _no_progress(finished: int, mean: float) -> None:
    pass


def play_episodes(
    runtime: PolicyRuntime,
    environments: VectorEnvironment,
    episodes: int,
    seed: int,
    *,
    sampled: bool,
    progress: Callable[[int, float], None] = _no_progress,
) -> Evaluation:
    """Play `episodes` episodes and return their results.

    Each environment plays its share of the episodes, and any further ones are not counted: counting whichever episodes
    end first would favour short ones.

    Args:
      runtime: the policy, with its weights loaded.
      environments: E environments; they are reset first, and not closed.
      episodes: how many to count.
      seed: of the environments and of sampled actions.
      sampled: sample the actions instead of choosing the most probable ones.
      progress: called after every step with the number of episodes counted and their mean return (NaN at first).
    """
    count = environments.count
    environment_seed, action_seed = np.random.SeedSequence(seed).generate_state(2)
    random = np.random.default_rng(action_seed)
    counter, counted = EpisodeCounter(count), _CountedEpisodes(episodes, count)
    stacks = ObservationStacks(environments.spaces, count)
    state = np.zeros((count, runtime.state_size), np.float32)
    observed = environments.reset(int(environment_seed))
    stacks.push(observed.frames, np.ones(count, np.bool_))
    neutral = neutral_noise(runtime.noise_size, count)
    while not counted.complete:
        valid = counter.valid
        noise = draw_noise(runtime.noise_size, count, random) if sampled else neutral
        choice = runtime.act(stacks.observations, state, noise, observed.masks)
        observed, rewards, terminated, truncated = environments.step(choice.actions)
        # As in RolloutWriter: the frame stack and the memory begin anew with each episode.
        stacks.push(observed.frames, ~valid)
        state = choice.state * valid[:, None]
        counter.step(rewards, terminated, truncated)
        ended = terminated | truncated
        if ended.any():
            counted.add(ended, counter.take_finished())
        progress(len(counted.returns), counted.mean_return)
    return Evaluation(returns=counted.returns, lengths=counted.lengths)


class _CountedEpisodes:
    """The results of the episodes that count: of each environment, its share from its first episode on."""

    def __init__(self, episodes: int, count: int) -> None:
        self._missing = np.full(count, episodes // count)  # [E] episodes of each environment's share
        self._missing[: episodes % count] += 1
        self.returns, self.lengths = np.zeros(0, np.float32), np.zeros(0, np.int32)
        self.mean_return = float("nan")

    @property
    def complete(self) -> bool:
        """Whether every environment has played its share."""
        return not self._missing.any()

    def add(self, ended: np.ndarray, finished: FinishedEpisodes) -> None:
        """Add the episodes that finished in the environments `ended` [E] bool, those beyond a share excepted."""
        counted = self._missing[ended] > 0
        self.returns = np.concatenate([self.returns, finished.returns[counted]])
        self.lengths = np.concatenate([self.lengths, finished.lengths[counted]])
        self._missing[ended] = np.maximum(self._missing[ended] - 1, 0)
        if len(self.returns):
            self.mean_return = float(self.returns.mean(dtype=np.float64))
