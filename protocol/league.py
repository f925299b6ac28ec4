"""What learners and actors say about the opponents of games: whom to play, and how matches ended.

A match is one episode of a game between two players. The first has the agents of one side, the second has all others.
A player is the newest policy, one of its kept versions, or a fixed opponent under its name in the settings.
"""

from typing import Annotated, Literal

from pydantic import Field

from daedalus.protocol.models import NaturalInt, Specification

NEWEST = "newest"  # the policy that learns, at whatever version an actor has it
RANDOM = "random"  # legal actions, all equally probable
DEFAULT_PAST_SHARE = 0.2  # of the matches of a game with opponents, against past versions
MAX_PLAYER = 200  # characters
MAX_SIDES = 1024
_MAX_PLAYERS = 512
_MAX_COUNTS = 4096

PlayerName = Annotated[str, Field(min_length=1, max_length=MAX_PLAYER)]
Weight = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
Purpose = Literal["training", "rating"]


def version_name(policy_version: int) -> str:
    """Return the name of the player that is a kept version of the policy."""
    return f"v{policy_version}"


def is_bot(player: str) -> bool:
    """Return whether a fixed opponent is code: the others are policies of other runs."""
    return player == RANDOM or ":" in player


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
    """Whom an actor lets play. It draws the opponent of each match from the plan that it has, so that it needs no
    answer of the learner between two matches."""

    revision: NaturalInt = 0  # increases with each change within a learner epoch
    training: Annotated[tuple[PlannedOpponent, ...], Field(max_length=_MAX_PLAYERS)] = ()
    rating: Annotated[tuple[PlannedRating, ...], Field(max_length=_MAX_PLAYERS)] = ()


class RatedPlayer(Specification):
    """Rating of a player, in points of its scale: the skill is within `deviation` of `rating` in two of three cases."""

    player: PlayerName
    rating: float
    deviation: float
    matches: NaturalInt = 0


class Score(Specification):
    """Results of the first player against the second."""

    first: PlayerName
    second: PlayerName
    wins: float = 0.0  # old matches of the newest policy count less, so that the numbers need not be whole
    draws: float = 0.0
    losses: float = 0.0


class LeagueStatus(Specification):
    """Ratings and results for people: status, page, report."""

    players: tuple[RatedPlayer, ...] = ()  # the newest policy first, then versions from old to new, then the others
    scores: tuple[Score, ...] = ()  # of pairs that have played, each once
