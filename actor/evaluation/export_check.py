"""Playing an exported policy with plain onnxruntime, beside the policy that it was made from."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
import onnxruntime
from gymnasium import spaces as gym

from daedalus.actor.environments.components import continuous_space, leaves, nested, only_of_batch, stacked
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.games import GameEnvironments
from daedalus.actor.environments.info import only_of_masks
from daedalus.actor.evaluation.loaded_policy import Policy, another_player, environments_of
from daedalus.policy.saving.onnx_graph import NOISE, noise_of

_LONGEST_EPISODE = 10_000  # steps; an environment may have no limit of its own
_SMALLEST = 1e-30  # range of an action: both bounds may be 0
# Of a number of an action, in parts of its range, of which float32 rounds parts, or of the action if that is larger.
TOLERANCE = 1e-5


class ExportedPlayer(Policy):
    """A policy that plays by its ONNX file, and compares each action with that of the policy itself.

    Both see the same observations and the same random numbers; the environment gets the action of the file.
    """

    @classmethod
    def of(cls, policy: Policy, model: bytes) -> "ExportedPlayer":
        """Return a player of an ONNX file that `policy` was exported to."""
        player = another_player(policy, cls)
        player._load(model)
        player.reset(seed=0)
        return player

    def _load(self, model: bytes) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        self._kinds = {"tensor(uint8)": np.uint8, "tensor(int64)": np.int64, "tensor(float)": np.float32}
        self._inputs = {entry.name: entry for entry in self._session.get_inputs()}
        self._rows = next(iter(self._inputs.values())).shape[0]
        self._rows = self._rows if isinstance(self._rows, int) else 1
        self._outputs = [entry.name for entry in self._session.get_outputs()]
        self._seen, self._acted = (
            leaves(space, name)
            for space, name in ((self.observation_space, "observation"), (self.action_space, "action"))
        )
        self._ranges = {leaf.name: _ranges(leaf.space) for leaf in self._acted}
        self.choices = self.different = 0  # actions, and those that differ from the policy's
        self.largest_difference = 0.0

    def reset(self, *, seed: int | None = None) -> None:
        """See Policy."""
        super().reset(seed=seed)
        if hasattr(self, "_session"):
            self._states = {
                name: np.zeros([self._rows, *entry.shape[1:]], self._kinds[entry.type])
                for name, entry in self._inputs.items()
                if name.startswith("state/")
            }

    def _choose(self, observation: Any, action_mask: Any, sampled: bool) -> Any:
        size = self._runtime.noise_size
        feed: dict[str, np.ndarray] = dict(self._states)
        observed = self._observed(observation, action_mask)
        masks = {self._transforms.mask_input(name): mask[0] for name, mask in observed.masks.items()}
        for leaf in self._seen:
            if leaf.name in self._inputs and leaf.name not in masks:
                masks[leaf.name] = leaf.of(observation)
        for name, values in masks.items():
            kind = self._kinds.get(self._inputs[name].type, np.bool_)
            feed[name] = np.repeat(np.asarray(values, kind)[None], self._rows, axis=0)
        if NOISE in self._inputs:
            uniform = self._random.random((1, *self._inputs[NOISE].shape[1:]), np.float32)
            feed[NOISE] = np.repeat(uniform, self._rows, axis=0)
            ours = self._decide(observation, action_mask, noise_of(uniform, size))
        else:
            ours = super()._choose(observation, action_mask, False)
        values: list[Any] = list(self._session.run(self._outputs, feed))
        results = dict(zip(self._outputs, values, strict=True))
        self._states = {name: results[f"next_{name}"] for name in self._states}
        parts = {}
        for leaf in self._acted:
            name = leaf.name if leaf.name not in self._inputs else f"actions/{leaf.name}"
            parts[leaf.path] = results[name][0].astype(leaf.space.dtype)
        theirs = nested(self.action_space, (), parts)
        self._compare(ours, theirs)
        return theirs

    def _compare(self, ours: Any, theirs: Any) -> None:
        differs = False
        for leaf in self._acted:
            expected, found = leaf.of(ours).astype(np.float64), leaf.of(theirs).astype(np.float64)
            sizes = np.maximum(np.maximum(self._ranges[leaf.name], np.abs(expected)), _SMALLEST)
            difference = float(np.nan_to_num(np.abs(expected - found) / sizes, nan=np.inf).max())
            continuous = isinstance(leaf.space, gym.Box)
            differs |= difference > (TOLERANCE if continuous else 0.0)
            if continuous:
                self.largest_difference = max(self.largest_difference, difference)
        self.choices += 1
        self.different += differs


def _ranges(space: gym.Space) -> np.ndarray:
    """Return the range of each number of an action between its bounds, or 1 where one is missing."""
    if not isinstance(space, gym.Box):
        return np.ones(space.shape or ())
    bounds = continuous_space(space)
    pairs = zip(bounds.low, bounds.high, strict=True)
    ranges = [1.0 if low is None or high is None else high - low for low, high in pairs]
    return np.reshape(ranges, space.shape)


@dataclass(frozen=True, slots=True, kw_only=True)
class Played:
    """What an exported policy did in its environment."""

    steps: int
    choices: int  # actions that the policy chose, over all seats; a repeated one counts once
    different: int  # of these, those that the policy itself would not have chosen
    largest_difference: float  # of a number of an action, in parts of its range, or of the action
    returns: tuple[float, ...]  # of the episodes that ended, without scaling; of a game the mean of the seats

    @property
    def mean_return(self) -> float:
        """Mean of the returns."""
        return float(np.mean(self.returns))

    def __str__(self) -> str:
        return f"{self.choices - self.different:,} of {self.choices:,} actions equal those of the run's policy" + (
            f", largest difference {self.largest_difference:.1e}" if self.largest_difference else ""
        )


def play_exported(
    policy: Policy, model: bytes, *, sampled: bool, seed: int, steps: int | None = None, episodes: int | None = None
) -> Played:
    """Play an exported policy in its environment, for a number of steps or of episodes.

    Raises EnvironmentSetupError if the environment cannot be made or fails.
    """
    done, total, returns = 0, 0.0, []
    with closing(environments_of(policy)) as environments:
        players = [ExportedPlayer.of(policy, model) for _ in range(environments.count)]

        def act(seat: int, observation: Any, mask: Any) -> Any:
            try:
                return players[seat].act(observation, sampled=sampled, action_mask=mask)
            except ValueError as error:  # of an observation that no policy can act on
                raise EnvironmentSetupError(f"environment {policy.spec.environment.id}: {error}") from None

        def begin(seed: int) -> None:
            for number, player in enumerate(players):
                player.reset(seed=seed + number)

        for reward, ended in _steps(environments, act, begin, seed):
            done, total = done + 1, total + reward
            if ended:
                returns.append(total)
                total = 0.0
            if done == steps or len(returns) == episodes:
                break
    return Played(
        steps=done,
        choices=sum(player.choices for player in players),
        different=sum(player.different for player in players),
        largest_difference=max(player.largest_difference for player in players),
        returns=tuple(returns),
    )


def _steps(
    environments: Any, act: Callable[[int, Any, Any], Any], begin: Callable[[int], None], seed: int
) -> Iterator[tuple[float, bool]]:
    """Yield the reward of each step, of a game the mean of the seats, and whether an episode ends with it; for ever."""
    games = environments if isinstance(environments, GameEnvironments) else None
    observed, action_space = environments.observation_space, environments.action_space
    for episode in count():
        observations, mask, ended = environments.reset(seed + episode), environments.action_mask, False
        begin(seed + episode)
        length = 0
        while not ended:
            acting = [seat for seat in range(environments.count) if games is None or games.acting[seat]]
            chosen = {
                seat: act(seat, only_of_batch(observed, observations, seat), _mask_of(mask, seat)) for seat in acting
            }
            others = next(iter(chosen.values()))  # has no effect
            actions = [chosen.get(seat, others) for seat in range(environments.count)]
            observations, rewards, terminated, truncated = environments.step(stacked(action_space, actions))
            mask, length = environments.action_mask, length + 1
            ended = bool(games.over.all()) if games is not None else bool((terminated | truncated).any())
            ended = ended or length >= _LONGEST_EPISODE
            yield float(rewards.mean()), ended


def _mask_of(mask: Any, row: int) -> Any:
    return None if mask is None else only_of_masks(mask, row)
