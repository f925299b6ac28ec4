"""Ratings and results of the players of a league, and the matches that follow from them. No I/O, no threads, no clock.

A rating is a skill with its standard deviation, by the Bradley-Terry model of Weng & Lin (2011), algorithm 1, as
openskill computes it. The scale is Elo's: a player with 200 points more wins 76 of 100 matches, and a draw is half a
win. One player is the zero of the scale: `random`, or else the first kept version.
"""

import math
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daedalus.learner.run.settings import SettingsError
from daedalus.protocol.league import (
    NEWEST,
    RANDOM,
    LeagueStatus,
    MatchCount,
    PlannedOpponent,
    PlannedRating,
    RatedPlayer,
    Score,
    version_name,
    version_of,
    wilson_interval,
)
from daedalus.protocol.models import Specification
from daedalus.protocol.spec import LeagueSpec

if TYPE_CHECKING:
    from openskill.models import BradleyTerryFull

_POINTS = 400.0 / math.log(10.0)  # by which a player must be stronger for e times as many wins as losses
_UNKNOWN = 350.0  # deviation of a player that has not played
# Smallest deviations of the newest policy, which changes, and of a version when it is kept: its rating is that of the
# newest, which follows a policy that improves.
_NEWEST, _KEPT = 50.0, 100.0
_ZERO = 1e-3  # deviation, for openskill, of the player that is the zero of the scale
_MEMORY = 200.0  # matches of the newest policy against a player that its results are over
_PRIOR = 10.0  # matches that the ratings count for, beside the results of a pair
_MOST_UPDATES = 400  # of ratings, by the results in one rollout: it takes 10 ms
_MOST_RETIRED = 512  # players that are gone, whose matches may still end
_RATING_PAIRS = 16  # beside the newest policy against each fixed opponent
_CONFIDENT = 100.0  # recent matches, from which a win rate counts as measured


def _order(player: str) -> tuple[int, int, str]:
    """Sort the newest policy first, then versions from old to new, then the others by name."""
    version = version_of(player)
    if version is not None:
        return 1, version, ""
    return (0 if player == NEWEST else 2), 0, player


class LeagueState(Specification):
    """What a checkpoint has of a league."""

    players: tuple[RatedPlayer, ...] = ()
    retired: tuple[RatedPlayer, ...] = ()
    scores: tuple[Score, ...] = ()


@dataclass(slots=True)
class _Skill:
    rating: float = 0.0
    deviation: float = _UNKNOWN  # 0: the zero of the scale
    matches: int = 0


@dataclass(slots=True)
class _Results:
    """Results of the first player of a pair, whose weights may be below one."""

    wins: float = 0.0
    draws: float = 0.0
    losses: float = 0.0

    @property
    def matches(self) -> float:
        return self.wins + self.draws + self.losses

    def add(self, wins: int, draws: int, losses: int, memory: float | None) -> None:
        """Add results; each match then counts 1 - 1 / memory times what it did before the next one."""
        count = wins + draws + losses
        kept, weight = 1.0, 1.0
        if memory is not None and count:
            kept = (1.0 - 1.0 / memory) ** count
            weight = (1.0 - kept) * memory / count
        self.wins = kept * self.wins + weight * wins
        self.draws = kept * self.draws + weight * draws
        self.losses = kept * self.losses + weight * losses


class Ratings:
    """The players of one league: the newest policy, its kept versions and the fixed opponents."""

    def __init__(self, fixed: Collection[str], state: LeagueState | None = None) -> None:
        """Continue from a state, or begin. Raises SettingsError if openskill is not installed.

        `fixed` are the names of the fixed opponents. Those of the state that are not among them are retired.
        """
        self._model = _model()
        self._skills: dict[str, _Skill] = {NEWEST: _Skill()}
        self._retired: OrderedDict[str, _Skill] = OrderedDict()  # the one that was retired longest ago first
        self._results: dict[tuple[str, str], _Results] = {}
        self.ignored = 0  # matches of versions that were retired too long ago
        for player in () if state is None else state.players:
            self._skills[player.player] = _Skill(player.rating, player.deviation, player.matches)
        for player in () if state is None else state.retired:
            self._retired[player.player] = _Skill(player.rating, player.deviation, player.matches)
        for score in () if state is None else state.scores:
            self._results[score.first, score.second] = _Results(score.wins, score.draws, score.losses)
        for player in [*self._skills]:
            if player not in fixed and player != NEWEST and version_of(player) is None:
                self.retire(player)
        for player in sorted(fixed, key=lambda name: name != RANDOM):
            self._add(player, _Skill(deviation=_UNKNOWN))

    def _add(self, player: str, skill: _Skill) -> None:
        if player in self._skills:
            return
        if player == RANDOM or version_of(player) is not None:
            every = [*self._skills.values(), *self._retired.values()]
            if not any(each.deviation == 0.0 for each in every):
                skill = _Skill(deviation=0.0)
        self._skills[player] = self._retired.pop(player, skill)

    # ------------------------------------------------------------------------------------------- players

    @property
    def players(self) -> list[str]:
        """The players, the newest policy first, then versions from old to new."""
        return sorted(self._skills, key=_order)

    @property
    def versions(self) -> list[int]:
        """The policy versions that are players, from old to new."""
        return sorted(version for player in self._skills if (version := version_of(player)) is not None)

    def keep(self, policy_version: int) -> None:
        """Make a version of the policy a player, with the rating of the newest policy, but none of its results."""
        newest, player = self._skills[NEWEST], version_name(policy_version)
        self._retired.pop(player, None)  # of the same number, before a resume
        self._add(player, _Skill(newest.rating, max(newest.deviation, _KEPT)))

    def retire(self, player: str) -> None:
        """Let a player play no more. Matches of it that end later still rate the others."""
        skill = self._skills.pop(player, None)
        if skill is None:
            return
        self._retired[player] = skill
        while len(self._retired) > _MOST_RETIRED:
            oldest = next((name for name, each in self._retired.items() if each.deviation), None)
            assert oldest is not None
            del self._retired[oldest]
        for pair in [pair for pair in self._results if player in pair]:
            del self._results[pair]

    def is_known(self, player: str) -> bool:
        """Return whether a match of the player may be reported. Versions may be any: they are retired all the time."""
        return player in self._skills or player in self._retired or version_of(player) is not None

    # ------------------------------------------------------------------------------------------- results

    def add(self, counts: Sequence[MatchCount], *, rate_training: bool) -> None:
        """Add the results of matches. Results of many matches count in the scores, and a part of them in the ratings.

        `rate_training`: whether matches of training count, as those that only rate do.
        """
        used = [each for each in counts if rate_training or each.purpose == "rating"]
        total = sum(each.wins + each.draws + each.losses for each in used)
        part = min(1.0, _MOST_UPDATES / max(total, 1))
        for each in used:
            results = each.wins, each.draws, each.losses
            first, second = self._find(each.first), self._find(each.second)
            if first is None or second is None or first is second:
                self.ignored += sum(results)
                continue
            for skill in (first, second):
                skill.matches += sum(results)
            if each.first in self._skills and each.second in self._skills:
                self._add_results(each.first, each.second, *results)
            newest = self._skills[NEWEST]
            for outcome in _mixed([math.ceil(count * part) for count in results]):
                self._rate(first, second, outcome)
                newest.deviation = max(newest.deviation, _NEWEST)

    def _find(self, player: str) -> _Skill | None:
        return self._skills.get(player) or self._retired.get(player)

    def _add_results(self, first: str, second: str, wins: int, draws: int, losses: int) -> None:
        if _order(first) > _order(second):
            first, second, wins, losses = second, first, losses, wins
        results = self._results.setdefault((first, second), _Results())
        results.add(wins, draws, losses, _MEMORY if first == NEWEST else None)

    def _rate(self, first: _Skill, second: _Skill, outcome: int) -> None:
        """Rate two players after a match; `outcome` is 0, 1 or 2: the first won, a draw, the second won."""
        one, two = (self._model.rating(skill.rating, skill.deviation or _ZERO) for skill in (first, second))
        ((one,), (two,)) = self._model.rate([[one], [two]], ranks=[[0.0, 1.0], [0.0, 0.0], [1.0, 0.0]][outcome])
        for skill, rated in ((first, one), (second, two)):
            if skill.deviation:
                skill.rating, skill.deviation = rated.mu, rated.sigma

    def win_probability(self, first: str, second: str) -> float:
        """Return the expected win rate of the first player by the ratings: of a draw, half counts.

        It is that of the update, equation 48 of Weng & Lin. openskill's `predict_win` is of another model.
        """
        return _expected(self._skills[first], self._skills[second])

    def win_rate(self, first: str, second: str) -> float:
        """Return the win rate of the first player by the results of the pair and, while there are few, the ratings.

        Ratings alone do not see that a player loses to one that is weaker against all others.
        """
        results, expected = self._results_of(first, second), self.win_probability(first, second)
        return (_PRIOR * expected + results.wins + results.draws / 2.0) / (_PRIOR + results.matches)

    def _results_of(self, first: str, second: str) -> _Results:
        if _order(first) <= _order(second):
            return self._results.get((first, second), _Results())
        found = self._results.get((second, first), _Results())
        return _Results(found.losses, found.draws, found.wins)

    def reach(self, target: LeagueSpec) -> bool:
        """Return whether the newest policy has the win rate or the rating of the settings; False without a target.

        One lucky series is not enough: the lower end of the 95 % interval must reach the target, after 100 matches. Old
        matches against the opponent count less, so that about 140 make 100.
        """
        if target.target_opponent is not None:
            results = self._results_of(NEWEST, target.target_opponent)
            share = (results.wins + results.draws / 2.0) / max(results.matches, 1.0)
            surely, _ = wilson_interval(share, results.matches)
            return results.matches >= _CONFIDENT and surely >= target.target_win_rate
        newest = self._skills[NEWEST]
        surely = newest.rating - 2.0 * newest.deviation
        return target.target_rating is not None and newest.matches >= _CONFIDENT and surely >= target.target_rating

    # --------------------------------------------------------------------------------------------- plans

    def training_plan(
        self, past_share: float, fixed: Mapping[str, float], *, prioritized: bool
    ) -> tuple[PlannedOpponent, ...]:
        """Return the opponents of the newest policy in training, each with its share of all matches.

        Args:
          past_share: of all versions together.
          fixed: share of each fixed opponent.
          prioritized: choose versions in proportion to p (1 - p) of the win rate p, and not uniformly.
        """
        weights = dict[str, float]()
        for version in self.versions:
            rate = self.win_rate(NEWEST, version_name(version)) if prioritized else 0.5
            weights[version_name(version)] = rate * (1.0 - rate)
        total = sum(weights.values())
        shares = {player: _short(past_share * weight / total) for player, weight in weights.items()}
        shares |= {player: share for player, share in fixed.items() if player in self._skills}
        return tuple(PlannedOpponent(player=player, weight=share) for player, share in shares.items() if share > 0.0)

    def rating_plan(self, fixed: Collection[str]) -> tuple[PlannedRating, ...]:
        """Return the matches that only rate, with their probabilities.

        Half of them are the newest policy against fixed opponents, whose win rates people look at. The other half are
        the pairs whose results tell most.
        """
        first = [(NEWEST, player) for player in fixed if player in self._skills]
        gains = sorted(((self.gain(*pair), pair) for pair in self._pairs()), reverse=True)[:_RATING_PAIRS]
        total = sum(gain for gain, _ in gains)
        weights = dict.fromkeys(first, 0.5 / max(len(first), 1))
        for gain, pair in gains:
            weights[pair] = weights.get(pair, 0.0) + (0.5 if first else 1.0) * (gain / total if total else 1.0)
        return tuple(
            PlannedRating(first=one, second=two, weight=_short(min(weight, 1.0)))
            for (one, two), weight in weights.items()
            if weight > 0.0
        )

    def _pairs(self) -> Iterator[tuple[str, str]]:
        players = self.players
        for number, first in enumerate(players):
            for second in players[number + 1 :]:
                yield first, second

    def gain(self, first: str, second: str) -> float:
        """Return how much a match of two players is expected to tell: the decrease of the variances of their ratings.

            sum over both of  deviation^4 / c^2 * p (1 - p)

        with the win probability p and c as in the update of Weng & Lin. It is large where ratings are uncertain, and
        the players about equally strong.
        """
        one, two = self._skills[first], self._skills[second]
        expected = _expected(one, two)
        return (one.deviation**4 + two.deviation**4) / _spread(one, two) ** 2 * expected * (1.0 - expected)

    # -------------------------------------------------------------------------------------------- reports

    def state(self) -> LeagueState:
        """Return everything that a checkpoint keeps."""
        status = self.status()
        retired = tuple(_rated(player, skill) for player, skill in self._retired.items())
        return LeagueState(players=status.players, retired=retired, scores=status.scores)

    def status(self) -> LeagueStatus:
        """Return the ratings and results for people."""
        pairs = sorted(self._results.items(), key=lambda item: (_order(item[0][0]), _order(item[0][1])))
        return LeagueStatus(
            players=tuple(_rated(player, self._skills[player]) for player in self.players),
            scores=tuple(
                Score(first=first, second=second, wins=results.wins, draws=results.draws, losses=results.losses)
                for (first, second), results in pairs
            ),
        )


def _rated(player: str, skill: _Skill) -> RatedPlayer:
    return RatedPlayer(player=player, rating=skill.rating, deviation=skill.deviation, matches=skill.matches)


def _spread(first: _Skill, second: _Skill) -> float:
    """c of Weng & Lin: how much better a player must be for e times as many wins, with what is not known of both."""
    return math.sqrt(_POINTS**2 + first.deviation**2 + second.deviation**2)


def _expected(first: _Skill, second: _Skill) -> float:
    return 1.0 / (1.0 + math.exp((second.rating - first.rating) / _spread(first, second)))


def _mixed(counts: Sequence[int]) -> list[int]:
    """Return each number from 0 as often as its count says, evenly spread: their order is not known."""
    places = [((place + 0.5) / count, number) for number, count in enumerate(counts) for place in range(count)]
    return [number for _, number in sorted(places)]


def _short(weight: float) -> float:
    """Round a weight, so that a plan stays the same while little changes."""
    return float(f"{weight:.2g}")


def _model() -> "BradleyTerryFull":
    try:
        from openskill.models import BradleyTerryFull
    except ImportError:
        raise SettingsError('ratings need openskill: pip install "daedalus-rl[pettingzoo]"') from None
    # With openskill's own gamma, deviations come out a third too large: they shrink more slowly than the model says.
    return BradleyTerryFull(mu=0.0, sigma=_UNKNOWN, beta=_POINTS / math.sqrt(2.0), tau=0.0, gamma=lambda *_: 1.0)
