"""Episodes played for somebody who watches: a picture of each step, and what the policy makes of it. No network."""

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from daedalus.actor.environments.gymnasium_backend import as_on_gymnasium
from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.rendering import FrameRate
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.evaluation.episodes import SEEDS, RunningEpisodes, refuse_unfit_rewards
from daedalus.policy.acting.noise import Noise, NoiseSize, draw_noise, joined_noise, neutral_noise
from daedalus.policy.acting.runtime import Choice, OnnxRuntime
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import DiscreteSpace, Spaces
from daedalus.protocol.spec import ActorSpec

_SAMPLES, _FEW_SAMPLES = 64, 8  # of the action, for its probabilities; few where the observation is large
_LARGE = 4096  # numbers in an observation
_MOST_SHOWN = 12  # choices or numbers of one component of the action
_LARGEST_SIDE = 640  # of a picture, in pixels


Estimate = Callable[[dict[str, np.ndarray], np.ndarray], float | None]


def _unknown(observations: dict[str, np.ndarray], state: np.ndarray) -> float | None:
    return None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """One step of an episode."""

    picture: np.ndarray  # [height, width, 3] uint8, after the step
    seconds: float  # that the step takes at the environment's own speed
    step: int  # from 1 in each episode
    reward: float  # in a game with several agents, their mean
    total: float  # of the rewards of this episode
    value: float | None  # estimate before the step, the mean of the agents that act; None if it is not known
    actions: list[dict[str, Any]]  # of the agents that act, see action_facts


class EpisodeCamera:
    """Episodes of one environment, rendered."""

    def __init__(self, spec: ActorSpec, modules: UserModules, estimate: Estimate = _unknown) -> None:
        """Make the environment. Raises EnvironmentSetupError.

        `estimate` returns the value of observations [1, *stacked_shape] and the policy's memory [1, S].
        """
        self._estimate = estimate
        environment = as_on_gymnasium(spec.environment).model_copy(update={"processes": False})
        self._picture, self._seconds = np.zeros((1, 1, 3), np.uint8), 0.0
        self._environments = make_environments(
            environment, 1, modules=modules, render_mode="rgb_array", camera=self._film, one_episode=True
        )
        played = self._environments
        self._names: tuple[str, ...] = ()
        self._agents = ("",)
        if isinstance(played, TransformedEnvironment):
            self._names = () if environment.action_table else played.action_names
            self._agents = played.agents or self._agents
        self._longest = spec.evaluation.max_episode_env_steps
        self._random = np.random.default_rng()

    def _film(self, picture: np.ndarray, rate: FrameRate) -> None:
        self._picture = picture
        self._seconds += 0.0 if rate.guess else 1.0 / rate.per_second  # of each repeated step

    @property
    def spaces(self) -> Spaces:
        """The run's spaces."""
        return self._environments.spaces

    def close(self) -> None:
        """Close the environment."""
        self._environments.close()

    def play(self, runtime: OnnxRuntime) -> Iterator[Moment]:
        """Play one episode with the most probable actions, and yield each step. Raises EnvironmentSetupError.

        The policy plays all agents of a game.
        """
        environments, spaces, seats = self._environments, self._environments.spaces, len(self._agents)
        running = RunningEpisodes(spaces, runtime, seats)
        observed = environments.reset(int(self._random.integers(SEEDS)))
        running.observe(observed)
        acting = np.arange(seats) if observed.acting is None else np.flatnonzero(observed.acting)
        total = 0.0
        for step in range(1, self._longest + 1):
            value = self._value(running, acting)
            choice = running.act(self._noise(runtime.noise_size, running.observations))
            taken = {name: values[:seats] for name, values in choice.actions.items()}
            self._seconds = 0.0
            observed, rewards, terminated, truncated = environments.step(taken)
            refuse_unfit_rewards(rewards, np.zeros(seats, np.int64))
            running.observe(observed)
            total += float(rewards.mean())
            yield Moment(
                picture=self._picture,
                seconds=self._seconds,
                step=step,
                reward=float(rewards.mean()),
                total=total,
                value=value,
                actions=self._facts(choice, acting),
            )
            ended = terminated | truncated
            if ended[0] if observed.over is None else observed.over[0]:
                return
            if observed.acting is not None:
                acting = np.flatnonzero(observed.acting & ~ended)

    def _value(self, running: RunningEpisodes, acting: np.ndarray) -> float | None:
        values = [
            self._estimate({name: rows[[seat]] for name, rows in running.observations.items()}, running.state[[seat]])
            for seat in acting
        ]
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known else None

    def _facts(self, choice: Choice, acting: np.ndarray) -> list[dict[str, Any]]:
        facts, seats = [], len(self._agents)
        for seat in acting[:_MOST_SHOWN]:
            values = {name: rows[seat::seats] for name, rows in choice.actions.items()}
            of_seat = Choice(values, choice.log_probs[seat::seats], choice.state[seat::seats])
            for fact in action_facts(self.spaces, of_seat, self._names):
                facts.append({**fact, "name": " ".join((self._agents[seat], fact["name"])).strip()})
        return facts[:_MOST_SHOWN]

    def _noise(self, size: NoiseSize, observations: dict[str, np.ndarray]) -> Noise:
        """Return noise that gives the most probable action in the first row of each seat, and samples in the others."""
        samples = _FEW_SAMPLES if sum(values.size for values in observations.values()) > _LARGE else _SAMPLES
        seats = len(self._agents)
        return joined_noise([neutral_noise(size, seats), draw_noise(size, samples * seats, self._random)])


def action_facts(spaces: Spaces, choice: Choice, names: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return what is known of the action, by component.

    A discrete one has `choices`: lists of a label, the probability and whether it was taken. The probabilities are
    exact if it is the whole action, since the program computes them for each sample; otherwise they are the shares of
    the samples. A continuous one has `numbers`: lists of the number taken and the standard deviation of the samples.

    Args:
      spaces: of the run.
      choice: the action taken in row 0, samples in the others.
      names: of the choices, if the environment has them and one discrete variable.
    """
    facts: list[dict[str, Any]] = []
    sole = len(spaces.actions) == 1
    for name, space in spaces.actions.items():
        values = choice.actions[name]
        if not isinstance(space, DiscreteSpace):
            spreads = values[1:].std(axis=0)
            pairs = [[float(taken), float(spread)] for taken, spread in zip(values[0], spreads, strict=True)]
            facts.append({"name": name, "numbers": pairs[:_MOST_SHOWN]})
            continue
        for variable in range(space.size):
            title = name if space.size == 1 else f"{name} {variable}"
            column = values[:, variable]
            if sole and space.size == 1:
                chances = np.exp(np.minimum(choice.log_probs, 0.0))
                shares = dict(zip(column.tolist(), chances.tolist(), strict=True))
            else:
                found, counts = np.unique(column[1:], return_counts=True)
                shares = dict(zip(found.tolist(), (counts / counts.sum()).tolist(), strict=True))
            known = names if sole and space.counts == (len(names),) else ()
            facts.append({"name": title, "choices": _choices(shares, int(column[0]), space.counts[variable], known)})
    return facts[:_MOST_SHOWN]


def _choices(shares: dict[int, float], taken: int, count: int, names: Sequence[str]) -> list[list[Any]]:
    """Return the choices in their order; of very many, the most probable ones."""
    shown = range(count)
    if count > _MOST_SHOWN:
        likely = sorted(shares, key=lambda choice: (choice != taken, -shares[choice]))
        shown = sorted(likely[:_MOST_SHOWN])
    labels = names or range(count)
    return [[str(labels[choice]), round(shares.get(choice, 0.0), 4), choice == taken] for choice in shown]


def jpeg(picture: np.ndarray) -> bytes:
    """Return a picture as a JPEG of moderate size. Raises ImportError without Pillow."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(picture[..., :3], np.uint8))
    image.thumbnail((_LARGEST_SIDE, _LARGEST_SIDE))
    data = io.BytesIO()
    image.save(data, "jpeg", quality=80)
    return data.getvalue()
