"""A match of one person against a policy: the person has one seat of a game, the policy has all others.

No network, no threads: the caller asks the person, and shows what a Turn says.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.games import make_games
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.environments.vector_environments import Observed
from daedalus.actor.evaluation.episodes import SEEDS, RunningEpisodes, refuse_unfit_rewards
from daedalus.policy.acting.noise import draw_noise, neutral_noise
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.policy.user_modules import UserModuleError, UserModules
from daedalus.protocol.spaces import DiscreteSpace, Spaces
from daedalus.protocol.spec import ActorSpec

_MOST_MOVES = 64  # of the policy, that a Turn has: the newest

Action = dict[str, list[float]]  # by component of the run's actions: an integer for each discrete variable, or numbers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Turn:
    """The match when the person must act, or after its end."""

    number: int  # of the turns before it in this match
    observation: dict[str, np.ndarray]  # newest of the person's seat, by component [*frame_shape]
    masks: dict[str, np.ndarray]  # of the masked actions [choices] bool, True for a legal choice
    moves: list[tuple[str, Action]]  # of the other seats since the person's last turn, by agent, the oldest first
    returns: dict[str, float]  # undiscounted sum of the rewards of each agent so far
    is_over: bool
    is_cut: bool  # whether the match is over because it has as many steps as an evaluation allows


class PersonMatch:
    """One copy of the game of a run, for one match after the other."""

    def __init__(self, spec: ActorSpec, modules: UserModules) -> None:
        """Make the game. Raises EnvironmentSetupError, also if the run plays no game with several agents."""
        environment = spec.environment
        if not environment.is_game:
            raise EnvironmentSetupError(
                f"{environment.id} is no game with several agents (environment.backend=pettingzoo): nobody can play it "
                "against the policy"
            )
        try:
            modules.check(environment.user_modules)
        except UserModuleError as error:
            raise EnvironmentSetupError(str(error)) from None
        self._games = make_games(environment, 1, modules, shown=True)
        try:
            self._environment = TransformedEnvironment(self._games, environment)
        except EnvironmentSetupError:
            self._games.close()
            raise
        self.agents = self._games.agents  # whose seats the policy can play
        self._longest = spec.evaluation.max_episode_env_steps
        self._random = np.random.default_rng()
        self._observed: Observed | None = None  # the newest; None before the first match

    @property
    def spaces(self) -> Spaces:
        """The run's spaces."""
        return self._environment.spaces

    def close(self) -> None:
        """Close the game."""
        self._environment.close()

    def begin(self, runtime: PolicyRuntime, agent: str, *, sampled: bool = False, seed: int | None = None) -> Turn:
        """Begin a match in which the person is an agent, and return the first turn.

        Args:
          runtime: the policy of the other seats.
          agent: one of `agents`.
          sampled: whether the policy samples its actions; otherwise it takes the most probable ones.
          seed: of the game; None: any.

        Raises EnvironmentSetupError for a fault of the game, PolicyError for one of the policy, ValueError for an agent
        that does not exist.
        """
        if agent not in self.agents:
            raise ValueError(f"there is no agent {agent!r}: choose from {', '.join(self.agents)}")
        self._seat, self._runtime, self._sampled = self.agents.index(agent), runtime, sampled
        count = len(self.agents)
        self._running = RunningEpisodes(self.spaces, runtime, count)
        self._returns, self._ended = np.zeros(count), np.zeros(count, np.bool_)
        self._number = self._steps = 0
        self._moves: list[tuple[str, Action]] = []
        self._see(self._environment.reset(int(self._random.integers(SEEDS)) if seed is None else seed))
        return self._play_on()

    def play(self, action: Mapping[str, Sequence[float]]) -> Turn:
        """Play an action of the person, and return her next turn. See `begin` for the errors.

        Raises ValueError for an action that is not legal now; nothing has changed then.
        """
        if self._observed is None or self._is_over or not self._must_act[self._seat]:
            raise ValueError("it is not your turn: begin a match")
        chosen = checked_action(self.spaces, self._masks, action)
        self._number, self._moves = self._number + 1, []
        self._step(chosen)
        return self._play_on()

    def picture(self) -> str | np.ndarray | None:
        """Return the game as it renders itself: a text, an image [H, W, 3] uint8, or None if it does neither."""
        return self._games.render()

    # ----------------------------------------------------------------------------------------------- the match

    @property
    def _is_over(self) -> bool:
        assert self._observed is not None
        assert self._observed.over is not None
        return bool(self._observed.over[0]) or self._steps >= self._longest

    @property
    def _must_act(self) -> np.ndarray:
        """Which agents choose an action now, [seats] bool: those with something new, unless it is their end."""
        assert self._observed is not None
        assert self._observed.acting is not None
        return self._observed.acting & ~self._ended

    @property
    def _masks(self) -> dict[str, np.ndarray]:
        assert self._observed is not None
        return {name: masks[self._seat].copy() for name, masks in self._observed.masks.items()}

    def _see(self, observed: Observed) -> None:
        self._observed = observed
        self._running.observe(observed)

    def _play_on(self) -> Turn:
        """Let the policy play until the person must act, or the match is over."""
        while not self._is_over and not self._must_act[self._seat]:
            self._step(None)
        assert self._observed is not None
        assert self._observed.over is not None
        return Turn(
            number=self._number,
            observation={name: frames[self._seat].copy() for name, frames in self._observed.frames.items()},
            masks=self._masks,
            moves=self._moves[-_MOST_MOVES:],
            returns=dict(zip(self.agents, self._returns.tolist(), strict=True)),
            is_over=self._is_over,
            is_cut=self._is_over and not self._observed.over[0],
        )

    def _step(self, persons: dict[str, np.ndarray] | None) -> None:
        count, size = len(self.agents), self._runtime.noise_size
        must_act = self._must_act
        noise = draw_noise(size, count, self._random) if self._sampled else neutral_noise(size, count)
        actions = dict(self._running.act(noise, must_act).actions)
        if persons is not None:
            for name, values in actions.items():
                actions[name] = values.copy()
                actions[name][self._seat] = persons[name]
        for seat in np.flatnonzero(must_act):
            if seat != self._seat:
                self._moves.append((self.agents[seat], {name: row[seat].tolist() for name, row in actions.items()}))
        observed, rewards, terminated, truncated = self._environment.step(actions)
        refuse_unfit_rewards(rewards, np.zeros(count, np.int64))
        self._returns += rewards
        self._steps += 1
        assert observed.acting is not None
        self._ended = np.where(observed.acting, terminated | truncated, self._ended)
        self._see(observed)


def checked_action(
    spaces: Spaces, masks: Mapping[str, np.ndarray], action: Mapping[str, Sequence[float]]
) -> dict[str, np.ndarray]:
    """Return an action of a person as the run has it, {name: [D]}. Raises ValueError if it is not legal.

    Args:
      spaces: of the run.
      masks: the legal choices of the masked components, [choices] bool.
      action: a number for each variable, by component.
    """
    if action.keys() != spaces.actions.keys():
        raise ValueError(f"an action has the components {', '.join(spaces.actions)}: give all of them")
    checked: dict[str, np.ndarray] = {}
    for name, space in spaces.actions.items():
        values = np.array(action[name], np.float64)
        if values.shape != (space.size,):
            raise ValueError(f"{name} has {values.size} numbers, but needs {space.size}")
        checked[name] = values.astype(space.dtype)
        if isinstance(space, DiscreteSpace):
            counts = np.array(space.counts)
            if (values != np.floor(values)).any() or (values < 0).any() or (values >= counts).any():
                raise ValueError(f"{name} must be whole numbers from 0, below {', '.join(map(str, counts))}")
            first = np.cumsum(counts) - counts
            if name in masks and not masks[name][first + checked[name]].all():
                raise ValueError("this move is not legal now: choose another")
        else:
            low, high = space.limits(np.float64)
            if not (np.isfinite(values) & (values >= low) & (values <= high)).all():
                raise ValueError(f"{name} must be numbers within {space}")
            # The run's actions are scaled to [-1, 1] where they have both bounds: see ContinuousSpace.
            bounded = np.isfinite(low) & np.isfinite(high)
            first, span = np.where(bounded, low, 0.0), np.where(bounded & (high > low), high - low, 2.0)
            checked[name] = np.where(bounded, 2.0 * (values - first) / span - 1.0, values).astype(space.dtype)
    return checked


def choices_of(space: DiscreteSpace, mask: np.ndarray | None) -> list[list[int]]:
    """Return the legal choices of each variable of an action component, given its mask [choices], or None."""
    legal = np.ones(sum(space.counts), np.bool_) if mask is None else mask
    parts = np.split(legal, np.cumsum(space.counts)[:-1])
    return [np.flatnonzero(part).tolist() for part in parts]


def result_of(turn: Turn, agent: str) -> str:
    """Return how a match ended for an agent, in one sentence: its return against the mean of the others."""
    others = [value for name, value in turn.returns.items() if name != agent]
    own = turn.returns[agent]
    if turn.is_cut:
        return f"The match was cut after as many steps as an evaluation allows; your return is {own:g}."
    if not others:
        return f"The match is over: your return is {own:g}."
    mean = sum(others) / len(others)
    outcome = "You won" if own > mean else "You lost" if own < mean else "A draw"
    return f"{outcome}: your return is {own:g}, {'that' if len(others) == 1 else 'the mean'} of the others {mean:g}."


def board_of(spec: ActorSpec, spaces: Spaces, turn: Turn, seat: int) -> dict[str, Any] | None:
    """Return the board of a game that is drawn as one, for the agent of a seat; None of other games.

    `rows`: the cells, each 0 (empty), 1 (of the first agent) or 2 (of the second). `moves`: "columns" if an action is a
    column, "cells" if it is a cell; cells are counted down the columns.
    """
    known = {"pettingzoo.classic.tictactoe_v": (3, 3), "pettingzoo.classic.connect_four_v": (6, 7)}
    shape = next((shape for name, shape in known.items() if spec.environment.id.startswith(name)), None)
    planes = turn.observation.get("observation")
    if shape is None or planes is None or planes.shape != (*shape, 2) or set(spaces.actions) != {"action"}:
        return None
    own, other = np.asarray(planes[:, :, 0]) != 0, np.asarray(planes[:, :, 1]) != 0
    cells = np.where(own, seat + 1, np.where(other, 2 - seat, 0))
    if shape == (6, 7):
        return {"moves": "columns", "rows": cells.tolist()}
    return {"moves": "cells", "rows": cells.T.tolist()}
