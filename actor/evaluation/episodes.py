"""Whole episodes played with a policy, and their returns. No network, no threads."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TextIO

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.vector_environments import Observed, VectorEnvironment
from daedalus.policy.acting.noise import Noise, NoiseSize, draw_noise, joined_noise, neutral_noise
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.runtime import Choice, PolicyRuntime
from daedalus.protocol.frames import ObservationStacks
from daedalus.protocol.spaces import Spaces, unfit_number
from daedalus.protocol.spec import CollectionSpec, EnvironmentSpec, EvaluationSpec
from daedalus.protocol.texts import short_number
from daedalus.transport.process_usage import available_processors

_Components = dict[str, np.ndarray]


class RunningEpisodes:
    """The frame stacks, the newest masks and the memory of a policy that plays one episode in each environment."""

    def __init__(self, spaces: Spaces, runtime: PolicyRuntime, environments: int) -> None:
        """Begin before the first observations of the episodes."""
        self._runtime, self._stacks = runtime, ObservationStacks(spaces, environments)
        self._starts = np.ones(environments, np.bool_)
        self._acting: np.ndarray | None = None  # [E] bool, of games: see Observed
        self._frames: _Components = {}  # the newest
        self._masks: _Components = {}
        self._state = np.zeros((environments, runtime.state_size), np.float32)

    @property
    def observations(self) -> _Components:
        """The newest observations of the policy, each [E, *stacked_shape]; views, valid until the next `observe`."""
        return self._stacks.observations

    @property
    def state(self) -> np.ndarray:
        """The memory of the policy [E, S] before it chooses the next actions."""
        return self._state

    def observe(self, observed: Observed) -> None:
        """Take what the environments show after a reset or a step."""
        self._acting = observed.acting
        if observed.acting is None:
            self._stacks.push(observed.frames, self._starts)
            self._starts[:] = False
        else:
            self._stacks.push(observed.frames, self._starts & observed.acting, observed.acting)
            self._starts &= ~observed.acting
        self._frames, self._masks = observed.frames, observed.masks

    def act(self, noise: Noise, playing: np.ndarray | None = None) -> Choice:
        """Choose the next actions.

        Args:
          noise: for E rows, or for a multiple of E: then all rows are repeated, for more samples of each action.
          playing: [E] bool, which episodes go on: the actions of the others have no effect; None: all.

        Returns: the choices of all rows of the noise. The first E are those of the environments; they alone change the
        memory. Raises EnvironmentSetupError for an observation, of an episode that goes on, which training refuses.
        """
        count = len(self._state)
        playing = np.ones(count, np.bool_) if playing is None else playing
        self._refuse_unfit(playing)
        repeats = len(noise.uniform) // count
        choice = self._runtime.act(
            {name: _repeated(values, repeats) for name, values in self.observations.items()},
            _repeated(self._state, repeats),
            noise,
            {name: _repeated(values, repeats) for name, values in self._masks.items()},
        )
        for name, values in choice.actions.items():
            if not np.isfinite(values[:count][playing]).all():
                raise PolicyError(f"the policy chose an action whose component {name!r} is not finite: do not use it")
        unknown = np.flatnonzero(np.isnan(choice.log_probs[:count]) & playing)
        if len(unknown):
            raise PolicyError(
                f"the policy has no probability for its action in environment {unknown[0]}: its observation has a "
                "value that is not among policy.codes, or the weights are not finite; correct the environment, or do "
                "not use this policy"
            )
        if self._acting is None:
            self._state = choice.state[:count]
        else:
            self._state = np.where(self._acting[:, None], choice.state[:count], self._state)
        return choice

    def _refuse_unfit(self, playing: np.ndarray) -> None:
        for name, frames in self._frames.items():
            if not unfit_number(frames):
                continue
            for row in np.flatnonzero(playing):
                if unfit := unfit_number(frames[row]):
                    raise EnvironmentSetupError(
                        f"the environment returned an observation whose component {name!r} {unfit}, in environment "
                        f"{row}: the policy cannot act on it, and training refuses it; correct `reset` or `step`"
                    )


def refuse_unfit_rewards(rewards: np.ndarray, numbers: np.ndarray) -> None:
    """Raise EnvironmentSetupError if a reward [n] of the episodes `numbers` [n] is not finite: they have no return."""
    faulty = ~(np.abs(rewards) <= np.finfo(np.float32).max)  # of float32, as training has them
    if faulty.any():
        raise EnvironmentSetupError(
            f"the environment gave the reward {rewards[faulty][0]} in episode {numbers[faulty][0] + 1} of the "
            "evaluation: rewards must be finite in float32; correct its `step`"
        )


def _repeated(rows: np.ndarray, repeats: int) -> np.ndarray:
    return rows if repeats == 1 else np.concatenate([rows] * repeats)


_MAX_ENVIRONMENTS = 100
SEEDS = 2**30  # seeds of environments are below it plus the number of episodes: every backend takes them
LONGEST = EvaluationSpec().max_episode_env_steps
PROGRESS_SECONDS = 5.0  # between two lines
_ENVIRONMENTS_PER_PROCESSOR = 4  # if each is a process: enough to keep a processor busy, and few enough to start fast


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The results of an evaluation's episodes, in the order of their seeds."""

    returns: np.ndarray  # [episodes] float64, undiscounted and unscaled
    lengths: np.ndarray  # [episodes] int32, env_steps
    cut: np.ndarray  # [episodes] bool, whether the episode was cut: its return is that of the part that was played


def environments_for(episodes: int, spec: EnvironmentSpec, collection: CollectionSpec) -> int:
    """Return how many environments to create for so many episodes: at most as many as play in training.

    A simulator may allow no more, for its memory, ports or licences.
    """
    most = min(_MAX_ENVIRONMENTS, collection.actors * collection.envs_per_actor)
    if spec.processes and spec.backend == "gymnasium":
        most = min(most, _ENVIRONMENTS_PER_PROCESSOR * available_processors())
    return min(episodes, most)


def cut_note(spec: EnvironmentSpec, cut: int, episodes: int, longest: int, *, sampled: bool) -> str:
    """Return a message about the episodes of an evaluation that were cut."""
    greedy = "" if sampled else "greedy actions may go in circles where sampled ones do not (--actions sampled); "
    return (
        f"{cut} of {episodes} episodes were cut after {longest:,} env_steps (evaluation.max_episode_env_steps): "
        f"{greedy}{spec.remedy_of_endless}"
    )


def no_progress(finished: int, mean: float) -> bool:
    """Show nothing, and let the evaluation go on."""
    return False


class EvaluationStoppedError(Exception):
    """Error of an evaluation that was stopped before its last episode ended."""


class EvaluationProgress:
    """Callback that reports progress every few seconds, and raises EvaluationStoppedError when `stop` is set.

    On a terminal it rewrites one line.
    """

    def __init__(self, stream: TextIO, episodes: int, longest: int, stop: threading.Event) -> None:
        self._stream, self._episodes, self._longest, self.stop = stream, episodes, longest, stop
        self._terminal = stream.isatty()
        self._due = time.monotonic() + PROGRESS_SECONDS
        self._rewriting = False

    def __call__(self, finished: int, mean: float) -> bool:
        """Show how many episodes have finished, and their mean return. Return False: the evaluation goes on."""
        if self.stop.is_set():
            raise EvaluationStoppedError
        if time.monotonic() < self._due:
            return False
        self._due = time.monotonic() + PROGRESS_SECONDS
        so_far = (
            f", mean return {short_number(mean)}" if finished else f" (each is cut after {self._longest:,} env_steps)"
        )
        line = f"evaluation: {finished} of {self._episodes} episodes{so_far}"
        self._stream.write(f"\r\x1b[K{line}" if self._terminal else f"{line}\n")
        self._stream.flush()
        self._rewriting = self._terminal
        return False

    def end(self) -> None:
        """Clear the rewritten line."""
        if self._rewriting:
            self._stream.write("\r\x1b[K")
            self._stream.flush()


def play_episodes(
    runtime: PolicyRuntime,
    environments: VectorEnvironment,
    episodes: int,
    seed: int,
    *,
    sampled: bool,
    longest: int = LONGEST,
    progress: Callable[[int, float], bool] = no_progress,
) -> Evaluation:
    """Play `episodes` episodes and return their results, in the order of their numbers.

    Episode i has seeds of its own, made of `seed` and i, for its environment and its sampled actions. So its result
    does not depend on how many environments there are, if a reset with a seed determines the whole episode.

    The episodes are played in rounds, one episode in each environment. All episodes that begin are counted: counting
    whichever end first would favour short ones.

    Args:
      runtime: the policy, with its weights loaded.
      environments: E environments, made for evaluation; they are reset first, and not closed.
      episodes: how many to play.
      seed: of the environments and of sampled actions.
      sampled: sample the actions instead of choosing the most probable ones.
      longest: cut each episode after this many env_steps.
      progress: called after every step with the number of episodes that ended and their mean return (NaN at first).
        If it returns True, the episodes in progress are cut, and no other begins.

    Returns: the results of the episodes that began. Raises EnvironmentSetupError for a reward that is not finite, and
    for an observation that a policy cannot act on.
    """
    environment_seed, action_seed = (int(word) for word in np.random.SeedSequence(seed).generate_state(2))
    table = _Table(runtime, environments, episodes, progress)
    seats = environments.seats
    for first in range(0, episodes, environments.count // seats):
        noise = EpisodeNoise(runtime.noise_size, action_seed, first * seats, environments.count, sampled)
        observed = environments.reset(environment_seed % SEEDS + first)  # environment e gets this seed + e
        if not table.play(observed, noise, first, longest):
            break
    return table.results()


def _refuse_unfit_returns(returns: np.ndarray) -> None:
    """Raise EnvironmentSetupError for a sum of finite rewards that float32 cannot hold."""
    faulty = np.abs(returns) > np.finfo(np.float32).max
    if faulty.any():
        raise EnvironmentSetupError(
            f"the return of episode {np.flatnonzero(faulty)[0] + 1} of the evaluation is {returns[faulty][0]:g}, which "
            "float32 cannot hold: scale the rewards of the environment"
        )


class EpisodeNoise:
    """The noise of a round: row e draws from the generator of episode `first` + e; neutral if not sampled.

    A single row is computed twice, as a batch of two: for a batch of one, matrix products use another kernel, which
    rounds differently.
    """

    def __init__(self, size: NoiseSize, seed: int, first: int, count: int, sampled: bool) -> None:
        rows = max(count, 2)
        self._size, self._neutral = size, None if sampled else neutral_noise(size, rows)
        self._generators = [np.random.default_rng([seed, first + row]) for row in range(rows)]

    def draw(self) -> Noise:
        """Return the noise of one step."""
        if self._neutral is not None:
            return self._neutral
        return joined_noise([draw_noise(self._size, 1, generator) for generator in self._generators])


class _Table:
    """The environments, and the running returns and lengths of all episodes, by number."""

    def __init__(
        self,
        runtime: PolicyRuntime,
        environments: VectorEnvironment,
        episodes: int,
        progress: Callable[[int, float], bool],
    ) -> None:
        self._runtime, self._environments, self._progress = runtime, environments, progress
        self._returns = np.zeros(episodes, np.float64)
        self._lengths = np.zeros(episodes, np.int32)
        self._ended = np.zeros(episodes, np.bool_)

    def play(self, observed: Observed, noise: EpisodeNoise, first: int, longest: int) -> bool:
        """Play episode `first` + e in each environment e, from the first observations on. See play_episodes.

        An episode of a game is a match, whose seats are all played by the policy; its return is their mean.

        What an environment does after the end of its episode is ignored. Returns False if `progress` asked to stop.
        """
        environments, seats = self._environments, self._environments.seats
        games = environments.count // seats
        numbers = first + np.arange(games)  # of the episodes
        running = RunningEpisodes(environments.spaces, self._runtime, environments.count)
        running.observe(observed)
        playing = numbers < len(self._returns)
        for _ in range(longest):
            choice = running.act(noise.draw(), np.repeat(playing, seats))
            actions = {name: values[: environments.count] for name, values in choice.actions.items()}
            observed, rewards, terminated, truncated = environments.step(actions)
            rewards = rewards if seats == 1 else rewards.reshape(games, seats).mean(axis=1)
            refuse_unfit_rewards(rewards[playing], numbers[playing])
            running.observe(observed)
            self._returns[numbers[playing]] += rewards[playing]
            self._lengths[numbers[playing]] += 1
            ended = playing & (terminated | truncated if observed.over is None else observed.over)
            self._ended[numbers[ended]] = True
            playing &= ~ended
            mean = float(self._returns[self._ended].mean()) if self._ended.any() else float("nan")
            if self._progress(int(self._ended.sum()), mean):
                return False
            if not playing.any():
                break
        return True

    def results(self) -> Evaluation:
        """Return the results of the episodes that began."""
        _refuse_unfit_returns(self._returns)
        played = self._lengths > 0
        return Evaluation(returns=self._returns[played], lengths=self._lengths[played], cut=~self._ended[played])
