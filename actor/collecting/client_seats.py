"""The seats of a game that a client's own loop hosts. State without threads or I/O."""

from collections.abc import Sequence
from dataclasses import dataclass

import gymnasium

from daedalus.actor.environments.components import AGENT, with_agent
from daedalus.actor.errors import ActorError
from daedalus.protocol import keys
from daedalus.protocol.spec import ActorSpec

MAX_SEATS = 64  # of one match


class MatchSteps:
    """Which rows of the seats of a match begin a step of the game, where several seats act in one step."""

    def __init__(self) -> None:
        self._acted = set[int]()  # seats, in this step
        self._counted = False
        self._ended = False  # an episode has ended: the next action begins a step

    def act(self, seat: int) -> None:
        """Note that a seat acts. A step begins with a seat that has acted in the one before."""
        if self._ended or seat in self._acted:
            self._acted.clear()
            self._counted = self._ended = False
        self._acted.add(seat)

    def count(self) -> bool:
        """Count a row to learn from; return whether it is the first in its step."""
        counted, self._counted = self._counted, True
        return not counted

    def end(self) -> None:
        """Note the end of an episode of a seat."""
        self._ended = True


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchSeat:
    """One seat of a match."""

    seats: tuple[str, ...]  # of the match, in the order of the agents of the game
    number: int  # of this seat
    steps: MatchSteps | None  # None: the seats act in turns, and each action is a step of the game


def match_seats(seats: Sequence[str], *, turns: bool) -> list[MatchSeat]:
    """Return the seats of one match. Raises ValueError for unfit names.

    Args:
      seats: their names, in the order of the agents of the game.
      turns: whether they act one after the other; otherwise those that act together make one step of the game.
    """
    if not 1 <= len(seats) <= MAX_SEATS:
        raise ValueError(f"a match has from 1 to {MAX_SEATS} seats, not {len(seats)}")
    for seat in seats:
        if not isinstance(seat, str) or not keys.is_name(seat):
            raise ValueError(
                f"the seat {ascii(seat)[:40]} is no name: use letters, digits, '.', '_' or '-', and begin with one of "
                "the first two"
            )
    if len(set(seats)) < len(seats):
        raise ValueError("two seats of the match have the same name")
    steps = None if turns else MatchSteps()
    return [MatchSeat(seats=tuple(seats), number=number, steps=steps) for number in range(len(seats))]


def seated_space(spec: ActorSpec, seat: MatchSeat | None, space: gymnasium.Space) -> gymnasium.Space:
    """Return what the policy observes of a client's observations: with the number of the seat, if the run asks for it.

    Raises ActorError if the run cannot take the seat, EnvironmentSetupError if the observation has a number already.
    """
    environment = spec.environment
    if seat is None:
        if environment.agent_ids and not (isinstance(space, gymnasium.spaces.Dict) and AGENT in space.spaces):
            raise ActorError(
                "this run lets the policy observe which agent it plays (environment.agent_ids): name the seats of the "
                f"match, or send the number of the agent as a component {AGENT!r}"
            )
        return space
    if seat.steps is not None and not environment.is_game:
        raise ActorError(
            "the seats of the match act together, but the run plays no game with several agents, and would count each "
            "action as a step: start the learner with --set environment.backend=pettingzoo"
        )
    if spec.lessons and len(seat.seats) > 1:
        raise ActorError(
            f"this run has lessons for {', '.join(sorted(spec.lessons))}, of which each seat of the match would get "
            "another value: start the run without lessons, or host one seat"
        )
    name = seat.seats[seat.number]
    if environment.agents and name not in environment.agents:
        raise ActorError(
            f"the policy does not play {name!r}: environment.agents of this run is {', '.join(environment.agents)}"
        )
    return with_agent(space, len(seat.seats)) if environment.agent_ids else space
