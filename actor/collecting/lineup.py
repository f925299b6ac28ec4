"""Who plays the seats of an actor's games: the newest policy, its past versions and fixed opponents. No network.

A copy of a game plays matches of one kind: the newest policy in all seats; the newest policy on one side, and an
opponent on all others; or any two players, only to rate them. docs/wire.md ("Games") says what is reported of them.
"""

import logging
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from daedalus.actor.environments.bots import Bot
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.games import GameEnvironments
from daedalus.policy.acting.noise import Noise, NoiseSize, draw_noise, neutral_noise
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.frames import ObservationStacks
from daedalus.protocol.league import (
    NEWEST,
    MatchCount,
    Matches,
    Plan,
    PlannedOpponent,
    Purpose,
    is_bot,
)
from daedalus.protocol.spec import LeagueSpec

_MOST_POLICIES = 32  # of opponents; beyond it the one that was chosen longest ago is forgotten
_NEWEST, _BOT = 0, -1  # players of seats; policies of opponents have numbers from 1


_logger = logging.getLogger(__name__)


class Match(NamedTuple):
    """One episode of a copy of the game between two players; NEWEST against itself is not counted."""

    purpose: Purpose
    first: str
    second: str
    side: int  # of the first


def sides_of(league: LeagueSpec, agents: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of the agents of each side. Raises EnvironmentSetupError if the settings do not fit."""
    if not league.sides:
        return tuple((seat,) for seat in range(len(agents))) if len(agents) == 2 else (tuple(range(len(agents))),)
    named = [agent for side in league.sides for agent in side]
    if sorted(named) != sorted(agents):
        raise EnvironmentSetupError(
            f"league.sides must name each agent of the policy once: it has {', '.join(named[:6])}, and the agents are "
            f"{', '.join(agents[:6])}"
        )
    sides = tuple(tuple(agents.index(agent) for agent in side) for side in league.sides)
    if len({len(side) for side in sides}) > 1:
        raise EnvironmentSetupError("league.sides must have equally many agents each: an opponent may have any of them")
    return sides


def outcome(means: Sequence[float], side: int) -> int:
    """Return 0 if a side has won a match, 1 for a draw, 2 if it has lost: against the best of the other sides.

    `means`: of the returns of each side's agents.
    """
    own, best = means[side], max(mean for other, mean in enumerate(means) if other != side)
    return 1 if math.isclose(own, best, rel_tol=1e-9, abs_tol=1e-9) else 0 if own > best else 2


def rating_copies(league: LeagueSpec, copies: int, agents: Sequence[str]) -> int:
    """Return how many copies of a game only rate players, besides `copies` that are learned from."""
    share = league.rating_share
    return math.ceil(share / (1.0 - share) * copies) if len(sides_of(league, agents)) > 1 else 0


def _shares_without_opponents(league: LeagueSpec) -> str:
    """Return the name of a setting that asks for opponents, or an empty string."""
    for name in ("past_share", "target_opponent", "target_rating"):
        if getattr(league, name):
            return name
    return "opponents" if any(league.opponents.values()) else ""


class _OpponentPolicy:
    """The policy of an opponent, with its memory of each seat."""

    def __init__(self, number: int, runtime: PolicyRuntime, seats: int) -> None:
        self.number, self.runtime = number, runtime
        self.state = np.zeros((seats, runtime.state_size), np.float32)


class Lineup:
    """The players of all seats of an actor's games, and the results of their matches.

    Attributes, each of all seats, those of a copy side by side:
      is_newest: whether the newest policy plays the seat.
      column: the column of a rollout that the seat's rows go to; -1 for seats that are not learned from.
      is_greedy: whether the player takes its most probable actions.
    """

    def __init__(
        self,
        league: LeagueSpec,
        games: GameEnvironments,
        copies: int,
        make_bot: Callable[[str], Bot],
        longest: int,
    ) -> None:
        """Construct the lineup; call `begin` before the games are reset.

        Args:
          league: the settings.
          games: the copies of the game: those that are learned from, and then those that only rate.
          copies: how many are learned from.
          make_bot: returns a new object that plays one seat, for a fixed opponent that is code.
          longest: number of steps after which a match that only rates is abandoned.

        Raises EnvironmentSetupError if the settings do not fit the game.
        """
        self._league, self._games, self._make_bot = league, games, make_bot
        self._sides = sides_of(league, games.agents)
        self._seats, self._copies, self._learned = games.seats, games.count // games.seats, copies
        share = 0.0
        if len(self._sides) > 1:
            share = league.past + sum(league.opponents.values())
        elif unused := _shares_without_opponents(league):
            raise EnvironmentSetupError(
                f"league.{unused} is set, but the agents of {games.name} ({', '.join(games.agents[:6])}) are one side "
                "and have no opponent: name the sides in league.sides, or leave it out"
            )
        with_opponents = min(round(share * copies), copies)
        if share > 0.0 and not with_opponents:
            _logger.warning(
                "no match is played against opponents, for %g of %d copies of the game is less than half a copy: set "
                "collection.envs_per_actor (--envs of an actor) to %d or more, or league.past_share to 0",
                share,
                copies,
                math.floor(0.5 / share) + 1,
            )
        self._alone = copies - with_opponents  # copies with the newest policy in all seats
        self.columns = self._alone * self._seats + with_opponents * max(map(len, self._sides))
        self.is_newest, self.is_greedy = np.ones(games.count, np.bool_), np.zeros(games.count, np.bool_)
        self.column = np.full(games.count, -1)
        self._player = np.zeros(games.count, np.int64)
        self._scores = np.zeros(games.count)
        self._current: list[Match | None] = [None] * self._copies
        self._next: list[Match | None] = [None] * self._copies
        self._bots: dict[tuple[str, int], Bot] = {}  # by name and seat
        self._policies: dict[str, _OpponentPolicy] = {}  # the one that was chosen longest ago first
        self._numbered: dict[int, _OpponentPolicy] = {}
        self._counts: dict[Match, list[int]] = {}
        self._longest, self._steps = longest, [0] * self._copies  # in the match of each copy
        self._warned = False  # of an abandoned match
        self._played, self._rated = 0, 0  # matches
        self._opponent, self._left = NEWEST, 0  # of the next matches, and of how many of them at least
        self._redraws = True  # whether a rollout has begun since it was drawn
        fixed = {name: weight for name, weight in league.opponents.items() if weight and is_bot(name)}
        self.plan = Plan(training=tuple(PlannedOpponent(player=name, weight=each) for name, each in fixed.items()))
        self.wanted = ""  # a player whose policy was to play and is not here; empty if there is none

    @property
    def against_opponents(self) -> range:
        """The copies in which the newest policy plays one side, against an opponent."""
        return range(self._alone, self._learned)

    @property
    def sides(self) -> int:
        """Number of sides of the game."""
        return len(self._sides)

    def describe(self) -> str:
        """Return what the copies play, in one line; empty if there are no opponents."""
        if len(self._sides) < 2:
            return ""
        parts = [f"{self._alone} against itself", f"{self._learned - self._alone} against opponents"]
        parts += [f"{rating} to rate players"] if (rating := self._copies - self._learned) else []
        return "matches of the newest policy, by copies of the game: " + ", ".join(parts)

    def begin(self, random: np.random.Generator) -> None:
        """Choose the players of the first matches; call it before the games are reset."""
        self._random = random
        self._policies.clear()
        self._numbered.clear()
        self._counts.clear()
        self._scores[:] = 0.0
        self._left, self._redraws = 0, True
        for copy in range(self._copies):
            self._choose(copy)

    # ------------------------------------------------------------------------------------------- policies

    @property
    def has_opponents(self) -> bool:
        """Whether any match may be against another player."""
        return self._alone < self._learned or self._learned < self._copies

    def add_policy(self, name: str, runtime: PolicyRuntime) -> None:
        """Let a policy play under a name from now on; the runtime has its weights."""
        if self.wanted == name:
            self.wanted = ""
        playing = set(self._player.tolist())
        for old, policy in list(self._policies.items()):
            if len(self._policies) < _MOST_POLICIES:
                break
            if policy.number not in playing and not self._is_chosen(old):
                del self._policies[old], self._numbered[policy.number]
        number = max(self._numbered, default=0) + 1
        self._policies[name] = self._numbered[number] = _OpponentPolicy(number, runtime, len(self._player))

    def give_up(self, name: str) -> None:
        """Note that the policy of a player is not to be had now."""
        if self.wanted == name:
            self.wanted = ""

    def _is_chosen(self, name: str) -> bool:
        return any(match is not None and name in (match.first, match.second) for match in self._next)

    def _is_here(self, name: str) -> bool:
        return name == NEWEST or name in self._policies or is_bot(name)

    # -------------------------------------------------------------------------------------------- matches

    def _choose(self, copy: int) -> None:
        """Choose the players of the next match of a copy, which its next reset begins."""
        if copy < self._alone:
            return
        match = self._next[copy] = self._drawn(copy)
        for side, seats in enumerate(self._sides):
            player = self._player_of(match, side)
            for seat in seats:
                seat += copy * self._seats
                self._games.seat_bot(seat, self._bot(player, seat) if is_bot(player) else None)

    @staticmethod
    def _player_of(match: Match | None, side: int) -> str:
        return NEWEST if match is None else match.first if side == match.side else match.second

    def _drawn(self, copy: int) -> Match | None:
        side = int(self._random.random() * len(self._sides))
        if copy < self._learned:
            # The same in a rollout, and in as many matches as copies play at once: one call then acts for all of them.
            if (self._redraws and self._left <= 0) or not self._is_here(self._opponent):
                drawn = self._pick({(NEWEST, each.player): each.weight for each in self.plan.training})
                self._opponent, self._left = NEWEST if drawn is None else drawn[1], self._learned - self._alone
                self._redraws = False
            self._left -= 1
            return Match("training", NEWEST, self._opponent, side)
        drawn = self._pick({(each.first, each.second): each.weight for each in self.plan.rating})
        return None if drawn is None else Match("rating", *drawn, side)

    def _pick(self, weights: dict[tuple[str, str], float]) -> tuple[str, str] | None:
        """Return a pair of players by the weights of pairs; if their policies are not here yet, one of those that are.

        Return None if there is none. The policy that is missing is wanted.
        """
        for pairs in (weights, {pair: weight for pair, weight in weights.items() if all(map(self._is_here, pair))}):
            below = np.cumsum(list(pairs.values()))
            if not pairs or below[-1] <= 0.0:
                return None
            chosen = list(pairs)[int(np.searchsorted(below, self._random.random() * below[-1], side="right"))]
            missing = [name for name in chosen if not self._is_here(name)]
            if not missing:
                for name in chosen:
                    if name in self._policies:
                        self._policies[name] = self._policies.pop(name)  # the newest chosen last
                return chosen
            self.wanted = self.wanted or missing[0]
        return None

    def _bot(self, name: str, seat: int) -> Bot:
        if (name, seat) not in self._bots:
            self._bots[name, seat] = self._make_bot(name)
        return self._bots[name, seat]

    def seat(self, copies: Sequence[int]) -> None:
        """Let the chosen players take the seats of copies whose match has begun."""
        for copy in copies:
            first = copy * self._seats
            seats = slice(first, first + self._seats)
            if copy < self._alone:  # not always in the same columns: some seats act more often than others
                self.column[seats] = self._random.permutation(self._seats) + first
                continue
            match = self._current[copy] = self._next[copy]
            self._scores[seats], self._steps[copy] = 0.0, 0
            self.column[seats] = -1
            for side, members in enumerate(self._sides):
                player = self._player_of(match, side)
                number = self._number(player)
                for seat in members:
                    self._player[first + seat] = number
                    self.is_newest[first + seat] = number == _NEWEST
                    if number > _NEWEST:
                        self._numbered[number].state[first + seat] = 0.0
            rates = copy >= self._learned
            self.is_greedy[seats] = rates and self._league.rating_actions == "greedy"
            if not rates:
                assert match is not None
                own = self._random.permutation(self._sides[match.side]) + first
                self.column[own] = self._alone * self._seats + (copy - self._alone) * len(own) + np.arange(len(own))

    def _number(self, player: str) -> int:
        if player == NEWEST:
            return _NEWEST
        return _BOT if is_bot(player) else self._policies[player].number

    def act(self, acting: np.ndarray, stacks: ObservationStacks, masks: dict[str, np.ndarray], actions: dict) -> None:
        """Write the actions of the opponents' policies in the seats that act.

        Args:
          acting: [seats] bool, the seats whose action has an effect.
          stacks, masks: of all seats.
          actions: of each component [seats, D].
        """
        if not self._policies:
            return
        others = (acting & (self._player > _NEWEST)).nonzero()[0]
        players = self._player[others]
        for number in sorted(set(players.tolist())):
            policy = self._numbered[number]
            seats = others[players == number]
            choice = policy.runtime.act(
                {name: values[seats] for name, values in stacks.observations.items()},
                policy.state[seats],
                self.noise(policy.runtime.noise_size, seats, self._random),
                {name: values[seats] for name, values in masks.items()},
            )
            if policy.runtime.state_size:
                policy.state[seats] = np.where(np.isfinite(choice.state), choice.state, np.float32(0.0))
            for name, values in actions.items():
                values[seats] = choice.actions[name]

    def noise(self, size: NoiseSize, seats: np.ndarray, random: np.random.Generator) -> Noise:
        """Return the noise for the actions of seats: neutral where the player is greedy."""
        noise = draw_noise(size, len(seats), random)
        if self._league.rating_actions != "greedy":
            return noise
        greedy = self.is_greedy[seats]
        if np.count_nonzero(greedy):
            neutral = neutral_noise(size, len(seats))
            noise = Noise(*(np.where(greedy[:, None], *pair) for pair in zip(neutral, noise, strict=True)))
        return noise

    def step(self, rewards: np.ndarray, ended: Sequence[int]) -> list[int]:
        """Count what a step brought, and return copies whose match is abandoned.

        Args:
          rewards: [seats], also those that come before the first action of an agent.
          ended: copies whose match ended with this step.
        """
        if self.has_opponents:
            self._scores += rewards
        for copy in ended:
            self._count(copy)
            rates = copy >= self._learned
            self._played, self._rated = self._played + (not rates), self._rated + rates
            if not rates:
                self._choose(copy)
        if self._learned == self._copies:
            return []
        abandoned = self._abandoned()
        if ended or abandoned:
            self._let_rate()
        return abandoned

    def _abandoned(self) -> list[int]:
        """Abandon the matches that only rate and do not end."""
        abandoned = []
        for copy in range(self._learned, self._copies):
            self._steps[copy] += 1
            if self._steps[copy] <= self._longest or self._games.is_over(copy):
                continue
            if not self._warned:
                self._warned = True
                _logger.warning(
                    "a match of %s and %s, which only rates them, is abandoned without a result: it did not end in %s "
                    "steps (evaluation.max_episode_env_steps)",
                    *(self._player_of(self._current[copy], side) for side in range(2)),
                    f"{self._longest:,}",
                )
            self._games.abandon(copy)
            self._rated += 1  # the next one begins when its turn comes
            abandoned.append(copy)
        return abandoned

    def _let_rate(self) -> None:
        """Let the copies that rate play as many matches as the settings say, and rest in between."""
        for copy in range(self._learned, self._copies):
            if not self._games.is_over(copy):
                continue
            share = self._league.rating_share
            self._games.resting[copy] = self._rated >= share * (self._played + self._rated)
            if not self._games.resting[copy]:
                self._choose(copy)
                self._games.resting[copy] = self._next[copy] is None

    def _count(self, copy: int) -> None:
        match = self._current[copy]
        if match is None or match.first == match.second:
            return
        first = copy * self._seats
        scores = self._scores[first : first + self._seats].tolist()
        means = [sum(scores[seat] for seat in side) / len(side) for side in self._sides]
        self._counts.setdefault(match, [0, 0, 0])[outcome(means, match.side)] += 1

    def take_matches(self) -> Matches | None:
        """Return the results of a rollout, since the last call; None if no match ended."""
        counts, self._counts, self._redraws = self._counts, {}, True
        if not counts:
            return None
        return Matches(
            counts=tuple(
                MatchCount(**match._asdict(), wins=wins, draws=draws, losses=losses)
                for match, (wins, draws, losses) in counts.items()
            )
        )
