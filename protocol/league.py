"""What learners and actors say about the opponents of games: whom to play, and how matches ended.

A match is one episode of a game between two players. The first has the agents of one side, the second has all others.
A player is the newest policy, one of its kept versions, or a fixed opponent under its name in the settings.
"""

import math
import re
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from daedalus.protocol.models import NaturalInt, Specification

NEWEST = "newest"  # the policy that learns, at whatever version an actor has it
RANDOM = "random"  # legal actions, all equally probable
MAX_PLAYER = 200  # characters
MAX_SIDES = 1024
_MAX_PLAYERS = 512
_MAX_COUNTS = 4096
_Z = 1.959963984540054  # of a normal distribution, 95 % of which lies between -z and z

PlayerName = Annotated[str, Field(min_length=1, max_length=MAX_PLAYER)]
Weight = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
Purpose = Literal["training", "rating"]


def version_name(policy_version: int) -> str:
    """Return the name of the player that is a kept version of the policy."""
    return f"v{policy_version}"


def version_of(player: str) -> int | None:
    """Return the policy version that a player is, or None if it is none."""
    match = re.fullmatch(r"v(0|[1-9]\d{0,18})", player, re.ASCII)
    return None if match is None else int(match[1])


def is_bot(player: str) -> bool:
    """Return whether a fixed opponent is code: the others are policies of other runs."""
    return player == RANDOM or ":" in player


def wilson_interval(share: float, matches: float) -> tuple[float, float]:
    """Return the 95 % interval of the probability of an outcome that `share` of `matches` had; 0 to 1 without matches.

    Wilson, E. B. (1927). Probable inference, the law of succession, and statistical inference. Equation 8.
    """
    if matches <= 0.0:
        return 0.0, 1.0
    square = _Z**2
    centre = (share + square / (2 * matches)) / (1 + square / matches)
    half = _Z / (1 + square / matches) * math.sqrt(share * (1 - share) / matches + square / (4 * matches**2))
    return (centre - half if share > 0.0 else 0.0), (centre + half if share < 1.0 else 1.0)


class MatchCount(Specification):
    """How matches of one purpose between two players ended, the first of which had one side."""

    purpose: Purpose
    first: PlayerName
    second: PlayerName
    side: Annotated[int, Field(ge=0, lt=MAX_SIDES)]  # of the first player
    wins: NaturalInt = 0  # of the first player: its agents had the larger mean return
    draws: NaturalInt = 0
    losses: NaturalInt = 0


class Matches(Specification):
    """The matches that ended in a rollout, except those of the newest policy against itself."""

    counts: Annotated[tuple[MatchCount, ...], Field(max_length=_MAX_COUNTS)] = ()


class PlannedOpponent(Specification):
    """Opponent of the newest policy in training, and how often it is chosen."""

    player: PlayerName
    weight: Weight


class PlannedRating(Specification):
    """Match of two players that tells how strong they are, and how often it is chosen."""

    first: PlayerName
    second: PlayerName
    weight: Weight


class Plan(Specification):
    """Whom an actor lets play. It draws opponents from the plan that it has, so that it needs no answer of the
    learner between two matches. The training matches that begin in a rollout may have the same opponent."""

    revision: NaturalInt = 0  # increases with each change within a learner epoch
    training: Annotated[tuple[PlannedOpponent, ...], Field(max_length=_MAX_PLAYERS)] = ()
    rating: Annotated[tuple[PlannedRating, ...], Field(max_length=_MAX_PLAYERS)] = ()


class RatedPlayer(Specification):
    """Rating of a player on the scale of Elo: a player with 200 points more wins 76 of 100 matches.

    The skill is within `deviation` of `rating` in two of three cases.
    """

    player: PlayerName
    rating: float
    deviation: float
    matches: NaturalInt = 0

    @property
    def text(self) -> str:
        """Rating and deviation for a person, such as `1,250 +- 50`."""
        return f"{round(self.rating):,} +- {round(self.deviation):,}"


class Score(Specification):
    """Results of the first player against the second."""

    first: PlayerName
    second: PlayerName
    wins: float = 0.0  # old matches of the newest policy count less, so that the numbers need not be whole
    draws: float = 0.0
    losses: float = 0.0

    @property
    def matches(self) -> float:
        """Number of matches."""
        return self.wins + self.draws + self.losses

    @property
    def win_rate(self) -> float:
        """Share of the matches that the first player has won; a draw is half a win. NaN without matches."""
        return (self.wins + self.draws / 2) / self.matches if self.matches else math.nan


STATUS_PLAYERS = 24  # at most in a status: a matrix that a person can read
_STATUS_BYTES = 48 << 10  # of their scores in a message, about; a status with all its actors has room for more
_SCORE_BYTES = 64  # without the names


class LeagueStatus(Specification):
    """Ratings and results for people: status, page, report."""

    # The newest policy first, then versions from old to new, then the others. See `bounded`.
    players: tuple[RatedPlayer, ...] = ()
    scores: tuple[Score, ...] = ()  # of pairs of `players` that have played, each once
    left_out: NaturalInt = 0  # number of players that are not in `players`

    @property
    def newest(self) -> RatedPlayer | None:
        """The newest policy; None before the first rating."""
        return next((each for each in self.players if each.player == NEWEST), None)

    @property
    def fixed_opponents(self) -> list[str]:
        """Names of the opponents that are neither the newest policy nor versions of it."""
        return [each.player for each in self.players if each.player != NEWEST and version_of(each.player) is None]

    @property
    def win_rates(self) -> dict[str, float]:
        """Win rate of the newest policy against each fixed opponent that it has played. See Score.win_rate."""
        scores = self.scores_of(NEWEST)
        return {name: scores[name].win_rate for name in self.fixed_opponents if name in scores}

    def scores_of(self, player: str) -> Mapping[str, Score]:
        """Return the results of a player against each other one that it has played, by the other's name."""
        found: dict[str, Score] = {}
        for score in self.scores:
            if score.matches and player == score.first:
                found[score.second] = score
            elif score.matches and player == score.second:
                turned = {"first": score.second, "second": score.first, "wins": score.losses, "losses": score.wins}
                found[score.first] = score.model_copy(update=turned)
        return found

    def bounded(self, most: int = STATUS_PLAYERS) -> "LeagueStatus":
        """Return the league with at most `most` players, fewer if their names are long, and the scores between them.

        The newest policy stays; of the others at most half are fixed opponents, those with the most matches, and the
        rest are versions from the oldest to the newest in equal distances.
        """
        versions = [each.player for each in self.players if version_of(each.player) is not None]
        matches = {each.player: each.matches for each in self.players}
        others = sorted(self.fixed_opponents, key=lambda name: -matches[name])
        others = others[: max((most - 1) // 2, most - 1 - len(versions))]
        kept = {NEWEST, *others, *_spread(versions, most - 1 - len(others))}
        scores = tuple(each for each in self.scores if each.first in kept and each.second in kept)
        size = sum(len(f"{each.first}{each.second}".encode()) + _SCORE_BYTES for each in scores)
        if size > _STATUS_BYTES:
            return self.bounded(most // 2)
        players = tuple(each for each in self.players if each.player in kept)
        left_out = self.left_out + len(self.players) - len(players)
        return LeagueStatus(players=players, scores=scores, left_out=left_out)


def _spread(names: list[str], most: int) -> list[str]:
    """Return at most `most` names, the first and the last and others in equal distances between them."""
    if len(names) <= most:
        return names
    return [names[round(place * (len(names) - 1) / max(most - 1, 1))] for place in range(most)]
