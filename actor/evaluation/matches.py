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


def play_matches(
    environments: TransformedEnvironment,
    sides: Sequence[Sequence[int]],
    policy: PolicyRuntime,
    opponent: PolicyRuntime | Callable[[], Bot],
    matches: int,
    seed: int,
    *,
    sampled: bool,
    openings: int = 0,
    longest: int = LONGEST,
    progress: Callable[[int, float], bool] = no_progress,
) -> MatchResults:
    """Play matches in which the policy has one side, and the opponent all others.

    Match k of each side has the same seed of the game and the same random opening. Its result does not depend on how
    many copies of the game there are, if a reset with a seed determines the whole match.

    Args:
      environments: copies of a game, which are reset first and not closed.
      sides: the numbers of the agents of each side, at least two sides.
      policy: with its weights loaded.
      opponent: another policy with its weights, or what makes a bot for one seat.
      matches: how many to play for each side.
      seed: of the games, of openings and of sampled actions.
      sampled: whether policies sample their actions instead of choosing the most probable ones.
      openings: number of env_steps at the start of each match in which all agents take random legal actions.
      longest: cut each match after this many env_steps.
      progress: called after every step with the number of matches that ended and the policy's mean return (NaN at
        first).

    Raises EnvironmentSetupError for faults of the game and of bots.
    """
    games = environments.games
    assert games is not None
    game_seed, action_seed, opening_seed = (int(word) for word in np.random.SeedSequence(seed).generate_state(3))
    seats, count = games.seats, games.count
    policies = [policy] if callable(opponent) else [policy, opponent]
    bots = [_OpeningBot(opponent(), games.action_space) for _ in range(count)] if callable(opponent) else []
    table = _Table(environments, sides, matches, openings, longest, progress)
    games.resting[:] = True  # a copy whose match is over waits for the others
    for side, members in enumerate(sides):
        noise_seed = int(np.random.SeedSequence([action_seed, side]).generate_state(1)[0])
        is_policys = np.tile(np.isin(np.arange(seats), list(members)), count // seats)
        for first in range(0, matches, count // seats):
            random = [np.random.default_rng([opening_seed, first + row // seats, row % seats]) for row in range(count)]
            for row, bot in enumerate(bots):
                bot.random = random[row]
                games.seat_bot(row, None if is_policys[row] else bot)
            players = [
                _Player(
                    RunningEpisodes(environments.spaces, runtime, count),
                    EpisodeNoise(runtime.noise_size, noise_seed, first * seats, count, sampled),
                    is_policys if number == 0 else ~is_policys,
                )
                for number, runtime in enumerate(policies)
            ]
            observed = environments.reset(game_seed % SEEDS + first)  # copy c gets this seed + c
            table.play(observed, players, bots, random, side, first)
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


class _Table:
    """The copies of the game, and the results of all matches: those of the first side, of the second and so on."""

    def __init__(
        self,
        environments: TransformedEnvironment,
        sides: Sequence[Sequence[int]],
        matches: int,
        openings: int,
        longest: int,
        progress: Callable[[int, float], bool],
    ) -> None:
        self._environments, self._sides, self._matches = environments, [list(side) for side in sides], matches
        self._openings, self._longest, self._progress = openings, longest, progress
        self._seats = environments.seats
        self._returns = np.zeros((len(sides) * matches, self._seats))
        self._lengths = np.zeros(len(sides) * matches, np.int32)
        self._ended = np.zeros(len(sides) * matches, np.bool_)
        self._finished: list[float] = []  # mean returns of the policy's agents in matches that ended
        self._courses: set[tuple[int, bytes]] = set()  # of the matches that ended

    def play(
        self,
        observed: Observed,
        players: Sequence[_Player],
        bots: Sequence[_OpeningBot],
        random: Sequence[np.random.Generator],
        side: int,
        first: int,
    ) -> None:
        """Play one match in each copy: `first` and the following ones of a side. `random` is that of openings."""
        copies = self._environments.count // self._seats
        playing = first + np.arange(copies) < self._matches
        records = side * self._matches + first + np.arange(copies)  # of the matches
        courses = [hashlib.blake2b(digest_size=16) for _ in range(copies)]
        for step in range(self._longest):
            for bot in bots:
                bot.opens = step < self._openings
            for player in players:
                player.episodes.observe(observed)
            for copy in np.flatnonzero(playing).tolist():
                courses[copy].update(self._shown(observed, copy))
            actions = self._actions(players, np.repeat(playing, self._seats))
            if step < self._openings:
                self._open(observed, actions, random, np.any([player.plays for player in players], axis=0))
            observed, rewards, _, _ = self._environments.step(actions)
            rewards = rewards.reshape(copies, self._seats)[playing]
            refuse_unfit_rewards(rewards.ravel(), np.repeat(records[playing], self._seats))
            self._returns[records[playing]] += rewards
            self._lengths[records[playing]] += 1
            assert observed.over is not None
            ended = playing & observed.over
            self._ended[records[ended]] = True
            playing &= ~ended
            for copy in np.flatnonzero(ended | (playing & (step + 1 == self._longest))).tolist():
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

    def _open(
        self,
        observed: Observed,
        actions: dict[str, np.ndarray],
        random: Sequence[np.random.Generator],
        plays: np.ndarray,
    ) -> None:
        """Write random legal actions in all seats that act and that policies play [seats]: bots draw their own."""
        assert observed.acting is not None
        for row in np.flatnonzero(observed.acting & plays).tolist():
            masks = {name: mask[[row]] for name, mask in observed.masks.items()}
            for name, values in RandomActions(self._environments.spaces.actions, random[row]).choose(masks).items():
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
        sides = np.repeat(np.arange(len(self._sides)), self._matches)
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
