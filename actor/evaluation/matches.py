"""Matches of a policy against an opponent, from every side of a game in turn, and their results. No network."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from daedalus.actor.collecting.lineup import outcome
from daedalus.actor.environments.bots import Bot, LegalActions, RandomActions
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.environments.vector_environments import Observed
from daedalus.actor.evaluation.episodes import (
    LONGEST,
    SEEDS,
    EpisodeNoise,
    RunningEpisodes,
    no_progress,
    refuse_unfit_rewards,
)
from daedalus.policy.acting.runtime import PolicyRuntime


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchResults:
    """The results of matches, ordered by the side of the policy."""

    sides: np.ndarray  # [matches] int64, the side that the policy had
    outcomes: np.ndarray  # [matches] int64: 0 the policy won, 1 a draw, 2 it lost
    returns: np.ndarray  # [matches, 2] float64, mean over the policy's agents, and over the opponent's
    lengths: np.ndarray  # [matches] int32, env_steps
    cut: np.ndarray  # [matches] bool, whether the match was cut: its result is that of the returns until then
    distinct: int  # number of matches that differ in what was observed


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchPlan:
    """Which matches to play, and how. Match k of each side has the same seed of the game and the same opening."""

    sides: Sequence[Sequence[int]]  # the numbers of the agents of each side, at least two sides
    matches: int  # of each side
    seed: int  # of the games, of openings and of sampled actions
    sampled: bool  # whether policies sample their actions instead of choosing the most probable ones
    openings: int = 0  # env_steps at the start of each match in which all agents take random legal actions
    longest: int = LONGEST  # env_steps, after which a match is cut


def play_matches(
    environments: TransformedEnvironment,
    plan: MatchPlan,
    policy: PolicyRuntime,
    opponent: PolicyRuntime | Callable[[], Bot],
    progress: Callable[[int, float], bool] = no_progress,
) -> MatchResults:
    """Play matches in which the policy has one side, and the opponent all others.

    The result of a match does not depend on how many copies of the game there are, if a reset with a seed determines
    the whole match.

    Args:
      environments: copies of a game, which are reset first and not closed.
      plan: the matches.
      policy: with its weights loaded.
      opponent: another policy with its weights, or what makes a bot for one seat.
      progress: called after every step with the number of matches that ended and the policy's mean return (NaN at
        first).

    Raises EnvironmentSetupError for faults of the game and of bots.
    """
    games = environments.games
    assert games is not None
    game_seed, action_seed, opening_seed = (int(word) for word in np.random.SeedSequence(plan.seed).generate_state(3))
    seats, count = games.seats, games.count
    policies = [policy] if callable(opponent) else [policy, opponent]
    bots = [_OpeningBot(opponent(), games.action_space) for _ in range(count)] if callable(opponent) else []
    table = _Table(environments, plan, progress)
    games.resting[:] = True  # a copy whose match is over waits for the others
    for side, members in enumerate(plan.sides):
        noise_seed = int(np.random.SeedSequence([action_seed, side]).generate_state(1)[0])
        is_policys = np.tile(np.isin(np.arange(seats), list(members)), count // seats)
        for first in range(0, plan.matches, count // seats):
            random = [np.random.default_rng([opening_seed, first + row // seats, row % seats]) for row in range(count)]
            for row, bot in enumerate(bots):
                bot.random = random[row]
                games.seat_bot(row, None if is_policys[row] else bot)
            players = [
                _Player(
                    RunningEpisodes(environments.spaces, runtime, count),
                    EpisodeNoise(runtime.noise_size, noise_seed, first * seats, count, plan.sampled),
                    is_policys if number == 0 else ~is_policys,
                )
                for number, runtime in enumerate(policies)
            ]
            observed = environments.reset(game_seed % SEEDS + first)  # copy c gets this seed + c
            table.play(_Round(side, first, players, bots, random), observed)
    return table.results()


class _OpeningBot:
    """A bot that may take random legal actions at the start of a match."""

    def __init__(self, bot: Bot, space: gymnasium.Space) -> None:
        self._bot, self._actions = bot, LegalActions(space)
        self.random = np.random.default_rng(0)
        self.opens = False

    def reset(self, agent: str, seed: int) -> None:
        """See Bot."""
        self._bot.reset(agent, seed)

    def act(self, observation: Any, action_mask: Any) -> Any:
        """See Bot."""
        if self.opens:
            return self._actions.sample(action_mask, self.random)
        return self._bot.act(observation, action_mask)


class _Player(NamedTuple):
    """A policy that observes all seats, and plays some of them."""

    episodes: RunningEpisodes
    noise: EpisodeNoise
    plays: np.ndarray  # [seats] bool


class _Round(NamedTuple):
    """One match in each copy of the game: match `first` of a side, and the following ones."""

    side: int
    first: int
    players: Sequence[_Player]
    bots: Sequence[_OpeningBot]
    random: Sequence[np.random.Generator]  # of openings, by seat


class _Table:
    """The copies of the game, and the results of all matches: those of the first side, of the second and so on."""

    def __init__(
        self, environments: TransformedEnvironment, plan: MatchPlan, progress: Callable[[int, float], bool]
    ) -> None:
        self._environments, self._plan, self._progress = environments, plan, progress
        self._sides = [list(side) for side in plan.sides]
        self._seats, count = environments.seats, len(plan.sides) * plan.matches
        self._returns = np.zeros((count, self._seats))
        self._lengths = np.zeros(count, np.int32)
        self._ended = np.zeros(count, np.bool_)
        self._finished: list[float] = []  # mean returns of the policy's agents in matches that ended
        self._courses: set[tuple[int, bytes]] = set()  # of the matches that ended

    def play(self, round: _Round, observed: Observed) -> None:
        """Play a round, from the first observations on."""
        side, plan, copies = round.side, self._plan, self._environments.count // self._seats
        numbers = round.first + np.arange(copies)  # of the matches of this side
        playing, records = numbers < plan.matches, side * plan.matches + numbers
        courses = [hashlib.blake2b(digest_size=16) for _ in range(copies)]
        for step in range(plan.longest):
            for bot in round.bots:
                bot.opens = step < plan.openings
            for player in round.players:
                player.episodes.observe(observed)
            for copy in np.flatnonzero(playing).tolist():
                courses[copy].update(self._shown(observed, copy))
            actions = self._actions(round.players, np.repeat(playing, self._seats))
            if step < plan.openings:
                self._open(round, observed, actions)
            observed, rewards, _, _ = self._environments.step(actions)
            rewards = rewards.reshape(copies, self._seats)[playing]
            refuse_unfit_rewards(rewards.ravel(), np.repeat(records[playing], self._seats))
            self._returns[records[playing]] += rewards
            self._lengths[records[playing]] += 1
            assert observed.over is not None
            ended = playing & observed.over
            self._ended[records[ended]] = True
            playing &= ~ended
            for copy in np.flatnonzero(ended | (playing & (step + 1 == plan.longest))).tolist():
                courses[copy].update(self._shown(observed, copy))
                self._courses.add((side, courses[copy].digest()))
            self._finished += self._returns[records[ended]][:, self._sides[side]].mean(axis=1).tolist()
            self._progress(len(self._finished), float(np.mean(self._finished)) if self._finished else float("nan"))
            if not playing.any():
                break

    def _actions(self, players: Sequence[_Player], playing: np.ndarray) -> dict[str, np.ndarray]:
        """Return what the policies choose {name: [seats, D]}; the actions in the seats of bots have no effect."""
        actions: dict[str, np.ndarray] = {}
        for player in players:
            choice = player.episodes.act(player.noise.draw(), playing & player.plays)
            for name, values in choice.actions.items():
                own = values[: len(playing)]
                actions[name] = np.where(player.plays[:, None], own, actions.get(name, own))
        return actions

    def _open(self, round: _Round, observed: Observed, actions: dict[str, np.ndarray]) -> None:
        """Write random legal actions in all seats that act and that policies play: bots draw their own."""
        assert observed.acting is not None
        plays = np.any([player.plays for player in round.players], axis=0)
        for row in np.flatnonzero(observed.acting & plays).tolist():
            masks = {name: mask[[row]] for name, mask in observed.masks.items()}
            chosen = RandomActions(self._environments.spaces.actions, round.random[row]).choose(masks)
            for name, values in chosen.items():
                actions[name][row] = values[0]

    def _shown(self, observed: Observed, copy: int) -> bytes:
        """Return what the seats of a copy see anew."""
        assert observed.acting is not None
        rows = slice(copy * self._seats, (copy + 1) * self._seats)
        acting = observed.acting[rows]
        frames = [observed.frames[name][rows][acting].tobytes() for name in sorted(observed.frames)]
        return b"".join([acting.tobytes(), *frames])

    def results(self) -> MatchResults:
        """Return the results of all matches."""
        sides = np.repeat(np.arange(len(self._sides)), self._plan.matches)
        means = np.stack([self._returns[:, members].mean(axis=1) for members in self._sides], axis=1)
        others = [[seat for seat in range(self._seats) if seat not in members] for members in self._sides]
        return MatchResults(
            sides=sides,
            outcomes=np.array([outcome(row.tolist(), side) for row, side in zip(means, sides.tolist(), strict=True)]),
            returns=np.array(
                [
                    (returns[self._sides[side]].mean(), returns[others[side]].mean())
                    for returns, side in zip(self._returns, sides.tolist(), strict=True)
                ]
            ),
            lengths=self._lengths,
            cut=~self._ended,
            distinct=len(self._courses),
        )
