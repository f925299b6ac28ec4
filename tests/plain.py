"""Spaces and values that are not composite, for tests of parts that treat all components alike."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from daedalus.actor.environments.vector_environments import VectorEnvironment
from daedalus.policy.acting.noise import Noise, NoiseSize, draw_noise, neutral_noise
from daedalus.policy.acting.runtime import Choice, PolicyRuntime
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces

NAME, ACTION = "observation", "action"


def plain_spaces(observation: ArraySpace, choices: int) -> Spaces:
    """Return spaces of one array and one discrete action."""
    return Spaces(observations={NAME: observation}, actions={ACTION: DiscreteSpace(counts=(choices,))})


def vector_spaces(size: int, choices: int) -> Spaces:
    """Return spaces of `size` numbers and one discrete action."""
    return plain_spaces(ArraySpace(shape=(size,), dtype="float32"), choices)


def array_space(spaces: Spaces) -> ArraySpace:
    """Return the only observation space."""
    (space,) = spaces.observations.values()
    assert isinstance(space, ArraySpace)
    return space


def choices(spaces: Spaces) -> int:
    """Return the number of choices of the only action."""
    (space,) = spaces.actions.values()
    assert isinstance(space, DiscreteSpace)
    return space.choices


class PlainEnvironments:
    """Environments of one array and one discrete action, with arrays in place of maps."""

    def __init__(self, environments: VectorEnvironment) -> None:
        self.environments = environments
        self.count, self.spaces = environments.count, environments.spaces

    def reset(self, seed: int) -> np.ndarray:
        """Return frames [E, *frame_shape]."""
        return self.environments.reset(seed).frames[NAME]

    def step(self, actions: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Take actions [E]; return frames, rewards, terminated, truncated."""
        observed, *rest = self.environments.step({ACTION: np.asarray(actions)[:, None]})
        rewards, terminated, truncated = rest
        return observed.frames[NAME], rewards, terminated, truncated

    def close(self) -> None:
        """Close the environments."""
        self.environments.close()


def act(
    runtime: PolicyRuntime, observations: np.ndarray, state: np.ndarray, random: np.random.Generator | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return actions [E], log-probabilities [E] and the next state: sampled with `random`, else greedy."""
    size, rows = runtime.noise_size, len(observations)
    noise = neutral_noise(size, rows) if random is None else draw_noise(size, rows, random)
    choice = runtime.act({NAME: observations}, state, noise, {})
    return choice.actions[ACTION][:, 0], choice.log_probs, choice.state


class PlainPolicy:
    """A policy of one array and one discrete action, which a test scripts by overriding `choose`."""

    state_size = 0
    noise_size = NoiseSize(uniform=2, normal=1)
    explores = False

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Ignore the weights."""

    def act(
        self,
        observations: dict[str, np.ndarray],
        state: np.ndarray,
        noise: Noise,
        masks: dict[str, np.ndarray],
        epsilon: np.ndarray | None = None,
    ) -> Choice:
        """See PolicyRuntime."""
        actions, log_probs, next_state = self.choose(plain(observations), state, noise)
        return Choice({ACTION: actions[:, None]}, log_probs, next_state)

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return actions [E], log-probabilities [E] and the next state [E, S] for observations [E, *stacked_shape]."""
        return np.zeros(len(observations), np.int64), np.zeros(len(observations), np.float32), state


class Always(PlainPolicy):
    """A policy that always takes the same action."""

    def __init__(self, action: int) -> None:
        self.action = action

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PlainPolicy."""
        return np.full(len(observations), self.action), np.zeros(len(observations), np.float32), state


class RowCounter(PlainPolicy):
    """A policy that takes random actions, and whose memory counts the rows of the episode."""

    state_size = 1

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See PlainPolicy."""
        return (noise.uniform[:, 0] * 5).astype(np.int64), observations[:, 2].copy(), state + 1.0


def plain(content: Any) -> Any:
    """Return the only component of a map."""
    (value,) = content.values()
    return value
