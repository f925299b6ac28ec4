"""Plays a policy in environments and gathers rollouts. No network, no threads."""

from dataclasses import dataclass

import numpy as np

from actor.environments import VectorEnvironment
from policy.runtime import PolicyRuntime
from protocol.frames import FrameStack
from protocol.messages import Rollout, RolloutIdentity
from protocol.spec import ArraySpace, EnvironmentSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishedEpisodes:
    """The episodes that ended in some rows, in the order of their ends."""

    returns: np.ndarray  # [K] float32, undiscounted and unscaled
    lengths: np.ndarray  # [K] int32, env_steps


class EpisodeCounter:
    """Follows E environments' running episodes; says which rows are valid and which episodes ended."""

    def __init__(self, count: int) -> None:
        self._returns = np.zeros(count, np.float64)
        self._lengths = np.zeros(count, np.int32)
        self._ended = np.zeros(count, np.bool_)
        self._finished: list[tuple[np.ndarray, np.ndarray]] = []

    @property
    def valid(self) -> np.ndarray:
        """[E] whether the next step is a real one, and not the reset after an episode's end."""
        return ~self._ended

    def step(self, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray) -> None:
        """Takes in one row: unscaled rewards [E], terminated [E], truncated [E]."""
        self._returns += rewards
        self._lengths += ~self._ended
        self._ended = terminated | truncated
        if self._ended.any():
            self._finished.append((self._returns[self._ended], self._lengths[self._ended]))
            self._returns[self._ended] = 0.0
            self._lengths[self._ended] = 0

    def take_finished(self) -> FinishedEpisodes:
        """The episodes that ended since the last call."""
        finished, self._finished = self._finished, []
        returns, lengths = zip(*finished, strict=True) if finished else ((), ())
        return FinishedEpisodes(
            returns=np.concatenate([np.zeros(0), *returns]).astype(np.float32),
            lengths=np.concatenate([np.zeros(0, np.int32), *lengths]),
        )


class Collector:
    """Holds E environments between rollouts, and the arrays that every rollout is written into.

    A rollout's arrays are views of them: encode it before the next `collect`.
    """

    def __init__(
        self,
        environments: VectorEnvironment,
        runtime: PolicyRuntime,
        spec: EnvironmentSpec,
        *,
        rollout_length: int,
        seed: int,
    ) -> None:
        rows, count = rollout_length, environments.count
        observation, action = environments.spaces.observation, environments.spaces.action
        self._environments = environments
        self._runtime = runtime
        self._reward_clip, self._reward_scale = spec.reward_clip, np.float32(spec.reward_scale)
        self._continuing = spec.continuing
        environment_seed, action_seed = np.random.SeedSequence(seed).generate_state(2)
        self._random = np.random.default_rng(action_seed)
        self._episodes = EpisodeCounter(count)
        self._stack = FrameStack(observation, count)
        self._state = np.zeros((count, runtime.state_size), np.float32)

        self._frames = _frames(observation, rows, count)
        self._initial_state = np.zeros_like(self._state)
        self._actions = np.zeros((rows, count), np.uint8 if action.count <= 256 else np.uint16)
        self._log_probs = np.zeros((rows, count), np.float32)
        self._rewards = np.zeros((rows, count), np.float32)
        self._terminated = np.zeros((rows, count), np.bool_)
        self._truncated = np.zeros((rows, count), np.bool_)
        self._valid = np.zeros((rows, count), np.bool_)
        self._stack.push(environments.reset(int(environment_seed)), np.ones(count, np.bool_))

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Plays on with these weights from the next rollout."""
        self._runtime.load(weights)

    def collect(self, identity: RolloutIdentity, policy_version: int) -> Rollout:
        """T rows more under the weights loaded last, whose version the caller names."""
        depth = self._stack.frames.shape[1]
        self._frames[:depth] = self._stack.frames.swapaxes(0, 1)
        self._initial_state[:] = self._state
        for row in range(len(self._actions)):
            valid = self._episodes.valid
            actions, self._log_probs[row], state = self._runtime.act(
                self._stack.observations, self._state, self._random
            )
            frames, rewards, terminated, truncated = self._environments.step(actions)
            self._frames[depth + row] = frames
            self._actions[row] = actions
            self._rewards[row] = rewards
            self._terminated[row] = terminated
            self._truncated[row] = truncated
            self._valid[row] = valid
            # The row after one that only reset is the first of its episode: nothing before it is remembered.
            self._stack.push(frames, ~valid)
            self._state = state * valid[:, None]
            self._episodes.step(self._rewards[row], self._terminated[row], self._truncated[row])
        if self._reward_clip is not None:
            self._rewards.clip(-self._reward_clip, self._reward_clip, out=self._rewards)
        self._rewards *= self._reward_scale
        if self._continuing:
            self._truncated |= self._terminated
            self._terminated[:] = False
        finished = self._episodes.take_finished()
        return Rollout(
            identity=identity,
            policy_version=policy_version,
            frames=self._frames,
            initial_state=self._initial_state,
            actions=self._actions,
            behaviour_log_probs=self._log_probs,
            rewards=self._rewards,
            terminated=self._terminated,
            truncated=self._truncated,
            valid=self._valid,
            episode_returns=finished.returns,
            episode_lengths=finished.lengths,
        )


def _frames(space: ArraySpace, rows: int, environments: int) -> np.ndarray:
    """Room for a rollout's frames [k-1 + T+1, E, *frame_shape].

    Images lie environment by environment, as they are sent: each beside the one that it differs little from.
    """
    length = space.frames + rows
    if len(space.shape) >= 2:
        return np.zeros((environments, length, *space.shape), space.dtype).swapaxes(0, 1)
    return np.zeros((length, environments, *space.shape), space.dtype)
