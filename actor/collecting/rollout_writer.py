"""Rollouts, written row by row: actions from a policy, outcomes from the caller. No network, no threads."""

import numpy as np

from daedalus.actor.collecting.episode_counter import EpisodeCounter
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.frames import FrameStack
from daedalus.protocol.messages import Rollout, RolloutIdentity
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec


class RolloutWriter:
    """The state that E environments carry from row to row, and the arrays that every rollout is written into.

    Call `start` once; then for each row `act`, step the environments, and `record`. After a `record` that returns True
    call `finish`.
    """

    def __init__(
        self,
        spaces: Spaces,
        count: int,
        runtime: PolicyRuntime,
        spec: EnvironmentSpec,
        *,
        rollout_length: int,
        random: np.random.Generator,
    ) -> None:
        """Allocate the arrays of a rollout.

        Args:
          spaces: of one environment, after the run's transforms.
          count: E, the number of environments.
          runtime: chooses the actions.
          spec: how rewards are clipped and scaled, and whether terminations are bootstrapped.
          rollout_length: T, the number of rows.
          random: source of the sampled actions.
        """
        rows = rollout_length
        observation, action = spaces.observation, spaces.action
        self._runtime = runtime
        self._reward_clip, self._reward_scale = spec.reward_clip, np.float32(spec.reward_scale)
        self._bootstrap_terminations = spec.bootstrap_terminations
        self._random = random
        self._episodes = EpisodeCounter(count)
        self._stack = FrameStack(observation, count)
        self._state = np.zeros((count, runtime.state_size), np.float32)
        self._next_state = self._state
        self._row = 0

        self._frames = _frames(observation, rows, count)
        self._initial_state = np.zeros_like(self._state)
        self._actions = np.zeros((rows, count), np.uint8 if action.count <= 256 else np.uint16)
        self._log_probs = np.zeros((rows, count), np.float32)
        self._rewards = np.zeros((rows, count), np.float32)
        self._terminated = np.zeros((rows, count), np.bool_)
        self._truncated = np.zeros((rows, count), np.bool_)
        self._valid = np.zeros((rows, count), np.bool_)

    @property
    def is_between_rollouts(self) -> bool:
        """Whether the next row is the first of a rollout: only then may the runtime load other weights."""
        return self._row == 0

    def start(self, frames: np.ndarray) -> None:
        """Begin with the first frames [E, *frame_shape] of all environments."""
        self._stack.push(frames, np.ones(len(frames), np.bool_))

    def act(self) -> np.ndarray:
        """Return the actions [E] that the policy chooses for the next row."""
        if self._row == 0:
            depth = self._stack.frames.shape[1]
            self._frames[:depth] = self._stack.frames.swapaxes(0, 1)
            self._initial_state[:] = self._state
        actions, self._log_probs[self._row], self._next_state = self._runtime.act(
            self._stack.observations, self._state, self._random
        )
        self._actions[self._row] = actions
        return actions

    def record(self, frames: np.ndarray, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray) -> bool:
        """Write what VectorEnvironment.step returned for those actions; return whether the rollout is full."""
        row, depth = self._row, self._stack.frames.shape[1]
        valid = self._episodes.valid
        self._frames[depth + row] = frames
        self._rewards[row] = rewards
        self._terminated[row] = terminated
        self._truncated[row] = truncated
        self._valid[row] = valid
        # The row after a reset row is the first of its episode: its frame stack and memory begin anew.
        self._stack.push(frames, ~valid)
        self._state = self._next_state * valid[:, None]
        self._episodes.step(self._rewards[row], self._terminated[row], self._truncated[row])
        self._row += 1
        return self._row == len(self._actions)

    def finish(
        self, identity: RolloutIdentity, policy_version: int, episode_info: dict[str, np.ndarray] | None = None
    ) -> Rollout:
        """Return the full rollout. Its arrays are views: encode or copy it before the next `act`.

        `episode_info` is that of the environments (VectorEnvironment.take_episode_info).
        """
        self._row = 0
        if self._reward_clip is not None:
            self._rewards.clip(-self._reward_clip, self._reward_clip, out=self._rewards)
        self._rewards *= self._reward_scale
        if self._bootstrap_terminations:
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
            episode_info=episode_info or {},
        )


def _frames(space: ArraySpace, rows: int, environments: int) -> np.ndarray:
    """Return an array for a rollout's frames [k-1 + T+1, E, *frame_shape].

    Images are stored environment by environment, as they are sent: consecutive images are alike and compress well.
    """
    length = space.frames + rows
    if len(space.shape) >= 2:
        return np.zeros((environments, length, *space.shape), space.dtype).swapaxes(0, 1)
    return np.zeros((length, environments, *space.shape), space.dtype)
