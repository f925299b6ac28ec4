"""The actors as the learner knows them: who takes part, with which identity, how they fare. State, no I/O.

The service owns the lock that guards it.
"""

import zlib
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from daedalus.protocol import keys
from daedalus.protocol.messages import Join, Refusal, RolloutIdentity
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.status import ActorStatus

_MOST_ACTORS = 16_384  # remembered at once
_REMEMBERED_LIVES = 8
_UNFIT_IN_A_ROW = 3  # rollouts, after which nothing more is taken from that life of the actor
_REORDERING = 1024  # sequence numbers that may arrive out of order before the missing ones are given up


@dataclass(slots=True)
class SequenceWindow:
    """Which sequence numbers of one incarnation were taken: each at most once, gaps counted."""

    low: int = 0  # all below were taken or given up
    gaps: int = 0  # how many were given up
    _above: set[int] = field(default_factory=set)  # taken, from `low` on

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.low or sequence in self._above

    def add(self, sequence: int) -> None:
        """Marks one as taken."""
        self._above.add(sequence)
        if sequence - self.low >= _REORDERING:
            low = sequence - _REORDERING + 1
            passed = {taken for taken in self._above if taken < low}
            self.gaps += low - self.low - len(passed)
            self._above -= passed
            self.low = low
        while self.low in self._above:
            self._above.remove(self.low)
            self.low += 1


@dataclass(slots=True)
class Actor:
    """One actor, over all its lives."""

    name: str
    incarnation: int = -1  # the newest; -1 before the first Join
    lives: int = 0
    environments: int = 0  # 0 until it has joined with its spaces
    last_seen: float = 0.0
    windows: dict[int, SequenceWindow] = field(default_factory=dict)  # by incarnation, the newest last
    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    busy: int = 0  # answers that told it to come again later
    unfit: int = 0  # rollouts in a row whose content no healthy actor sends
    quarantined: str = ""  # why nothing more is taken from its newest incarnation
    env_steps: int = 0
    env_steps_per_second: float = 0.0
    policy_lag: int = 0  # of its newest rollout
    compact_snapshots: bool = False  # it asks for snapshots that fit its link; to all others they are pushed
    received_bytes: int = 0  # rollouts, whatever became of them
    answered_bytes: int = 0  # snapshots that it asked for
    bytes_up_per_hour: float = 0.0
    bytes_down_per_hour: float = 0.0

    @property
    def sequences(self) -> SequenceWindow:
        """What was taken of its newest incarnation."""
        return self.windows[self.incarnation]

    @property
    def missed(self) -> int:
        """Rollouts that never came, of the incarnations that are remembered."""
        return min(sum(window.gaps for window in self.windows.values()), 2**53)

    def note_unfit(self, fault: str) -> None:
        """Counts a rollout of unfit content; the third in a row is the last that is looked at.

        In a row: a simulator that blows up once in a thousand rollouts loses those, a broken machine is shut out.
        """
        self.unfit += 1
        if self.unfit >= _UNFIT_IN_A_ROW:
            self.quarantined = f"{self.unfit} unfit rollouts in a row, the last: {fault}"

    def begin_life(self, incarnation: int) -> None:
        """A new process bears the name: it begins with a clean record.

        A life that comes back, after another that used its name, has what it sent remembered.
        """
        self.incarnation = incarnation
        self.lives += 1
        self.unfit, self.quarantined, self.compact_snapshots = 0, "", False
        self.windows[incarnation] = self.windows.pop(incarnation, SequenceWindow())
        while len(self.windows) > _REMEMBERED_LIVES:
            del self.windows[next(iter(self.windows))]


class Fleet:
    """All actors of a run, and the spaces they must share."""

    def __init__(self, seed: int, spaces: Spaces | None) -> None:
        self._seed = seed
        self.spaces = spaces  # the first actor's, or those of the checkpoint
        self.actors: dict[str, Actor] = {}  # that joined
        self.pushed_bytes = 0  # snapshots, to each that follows them
        self._present: dict[str, set[int]] = {}  # by name, the incarnations that liveliness tells of

    def join(self, join: Join, now: float) -> Refusal | None:
        """Takes in an actor; returns why not, if it cannot take part.

        A new incarnation of a known name replaces the old one, once that is gone. Who comes without spaces only asks
        what is played.
        """
        try:
            keys.check_name(join.actor, "actor name")
        except ValueError as error:
            return Refusal(code="malformed", reason=str(error))
        known = self.actors.get(join.actor)
        if known is not None and known.incarnation != join.incarnation and self.is_live(known):
            return Refusal(
                code="name_taken",
                reason=f"an actor named {join.actor!r} takes part already: give this one another --name",
            )
        if join.spaces is None:
            return None
        if not 1 <= join.environments <= 4096:
            return Refusal(code="malformed", reason=f"{join.environments} environments: must be 1 to 4096")
        if self.spaces is not None and join.spaces != self.spaces:
            return Refusal(
                code="mismatch",
                reason=f"its environment has {join.spaces}; this run has {self.spaces}: "
                "install the same version of the environment",
            )
        if join.actor not in self.actors and not self._make_room():
            return Refusal(code="full", reason=f"{_MOST_ACTORS} actors take part already")
        self.spaces = join.spaces
        actor = self.actors.setdefault(join.actor, Actor(join.actor))
        actor.last_seen = now
        if actor.incarnation != join.incarnation:
            actor.begin_life(join.incarnation)
        actor.environments = join.environments
        return None

    def _make_room(self) -> bool:
        """Forgets, where as many as there may be are known, who is away and was not seen for longest."""
        if len(self.actors) < _MOST_ACTORS:
            return True
        away = [actor for actor in self.actors.values() if not self.is_present(actor)]
        if away:
            del self.actors[min(away, key=lambda actor: actor.last_seen).name]
        return bool(away)

    def seed_for(self, name: str, start_version: int) -> int:
        """The seed of an actor's environments and samples: its own for each life of it, and after each resume."""
        lives = self.actors[name].lives if name in self.actors else 0
        entropy = [self._seed, zlib.crc32(name.encode()), lives, start_version]
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def set_present(self, name: str, incarnation: int, present: bool) -> None:
        """What liveliness says of one life of an actor."""
        if present:
            self._present.setdefault(name, set()).add(incarnation)
        elif name in self._present:
            self._present[name].discard(incarnation)
            if not self._present[name]:
                del self._present[name]

    def is_present(self, actor: Actor) -> bool:
        """Whether its newest incarnation is there."""
        return actor.incarnation in self._present.get(actor.name, ())

    def is_live(self, actor: Actor) -> bool:
        """Whether it takes part: it has joined, is present, and what it sends is taken."""
        return self.is_present(actor) and actor.environments > 0 and not actor.quarantined

    def received(self, name: str, size: int) -> None:
        """Counts what an actor sent."""
        if name in self.actors:
            self.actors[name].received_bytes += size

    def expected(self, identity: RolloutIdentity) -> Actor | None:
        """The actor a rollout is from, or None if that life of it has not joined."""
        actor = self.actors.get(identity.actor)
        if actor is None or actor.incarnation != identity.incarnation or not actor.environments:
            return None
        return actor

    @property
    def live(self) -> frozenset[str]:
        """The names of those that take part: the ones a synchronous batch waits for."""
        return frozenset(actor.name for actor in self.actors.values() if self.is_live(actor))

    def statuses(self, now: float) -> tuple[ActorStatus, ...]:
        """One line for each actor, by name."""
        return tuple(
            ActorStatus(
                actor=actor.name,
                alive=self.is_present(actor),
                quarantined=actor.quarantined,
                lives=actor.lives,
                seconds_since_seen=max(now - actor.last_seen, 0.0),
                environments=actor.environments,
                env_steps=actor.env_steps,
                env_steps_per_second=actor.env_steps_per_second,
                rollouts_accepted=actor.accepted,
                rollouts_rejected=dict(actor.rejected),
                rollouts_missed=actor.missed,
                busy_answers=actor.busy,
                policy_lag=actor.policy_lag,
                compact_snapshots=actor.compact_snapshots,
                bytes_up_per_hour=actor.bytes_up_per_hour,
                bytes_down_per_hour=actor.bytes_down_per_hour,
            )
            for actor in sorted(self.actors.values(), key=lambda actor: actor.name)
        )
