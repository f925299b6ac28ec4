"""State of all actors: presence, incarnations, received sequence numbers, statistics. No I/O.

The lock of the actor server guards it.
"""

import zlib
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from daedalus.protocol import keys
from daedalus.protocol.messages import Join, Refusal, RolloutIdentity
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.status import ActorStatus

_MAX_ACTORS = 16_384
_MAX_WINDOWS = 8  # incarnations of an actor whose sequence numbers are kept
_MAX_CONSECUTIVE_UNFIT = 3  # rollouts, after which the incarnation is quarantined
_MAX_NON_FINITE = 3  # rollouts without a finite gradient, after which the incarnation is quarantined
_FINITE_AGAIN = 100  # rollouts in a row with finite gradients, after which those before no longer count
_REORDERING = 1024  # largest distance of sequence numbers that arrive out of order


@dataclass(slots=True)
class SequenceWindow:
    """Received sequence numbers of one incarnation. Each number is accepted at most once; gaps are counted."""

    low: int = 0  # all numbers below were received or given up
    gaps: int = 0  # numbers that were given up
    _above: set[int] = field(default_factory=set)  # received numbers that are at least `low`

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.low or sequence in self._above

    def add(self, sequence: int) -> None:
        """Mark a sequence number as received."""
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
    """State of one actor, over all its incarnations."""

    name: str
    incarnation: int = -1  # the newest; -1 before the first Join
    incarnations: int = 0  # number of incarnations that joined
    environments: int = 0  # 0 before the actor has joined with its spaces
    last_seen: float = 0.0
    windows: dict[int, SequenceWindow] = field(default_factory=dict)  # by incarnation, the newest last
    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    busy: int = 0  # number of `busy` answers
    consecutive_unfit: int = 0  # rollouts that violate the specification
    non_finite: int = 0  # rollouts without a finite gradient
    finite_in_a_row: int = 0  # rollouts that were trained on since
    quarantined: str = ""  # the reason, if the newest incarnation is quarantined
    drained: bool = False  # whether an operator asked the newest incarnation to leave
    env_steps: int = 0
    env_steps_per_second: float = 0.0
    policy_lag: int = 0  # of the newest rollout
    fetches: bool = False  # whether the actor requests its snapshots instead of subscribing
    compact_snapshots: bool = False  # whether it requests compact snapshots
    received_bytes: int = 0  # rollouts, accepted or not
    answered_bytes: int = 0  # requested snapshots
    bytes_up_per_hour: float = 0.0
    bytes_down_per_hour: float = 0.0

    @property
    def sequences(self) -> SequenceWindow:
        """Sequence numbers received from the newest incarnation."""
        return self.windows[self.incarnation]

    @property
    def missed(self) -> int:
        """Number of rollouts that never arrived, over the last incarnations."""
        return min(sum(window.gaps for window in self.windows.values()), 2**53)

    def count_unfit(self, violation: str) -> None:
        """Count a rollout that violates the specification. Quarantine the actor after three in a row.

        Only consecutive rollouts count: an occasional failure of a simulator does not exclude the actor.
        """
        self.consecutive_unfit += 1
        if self.consecutive_unfit >= _MAX_CONSECUTIVE_UNFIT:
            self.quarantined = f"{self.consecutive_unfit} unfit rollouts in a row, the last: {violation}"

    def count_trained(self, *, finite: bool) -> None:
        """Count a rollout that was trained on. Quarantine the actor if several had no finite gradient.

        Unlike a rejected rollout, such a rollout costs the learner much time. Therefore it takes many good ones to make
        up for it.
        """
        if finite:
            self.finite_in_a_row += 1
            if self.finite_in_a_row >= _FINITE_AGAIN:
                self.non_finite = 0
            return
        self.rejected["non_finite"] += 1
        self.non_finite, self.finite_in_a_row = self.non_finite + 1, 0
        if self.non_finite >= _MAX_NON_FINITE:
            self.quarantined = (
                f"{self.non_finite} of its rollouts had no finite gradient: its observations or rewards are too large"
            )

    def start_incarnation(self, incarnation: int) -> None:
        """Set the newest incarnation, without quarantine.

        If the incarnation joined before, its received sequence numbers are still known.
        """
        self.incarnation = incarnation
        self.incarnations += 1
        self.consecutive_unfit = self.non_finite = self.finite_in_a_row = 0
        self.quarantined, self.drained = "", False
        self.fetches = self.compact_snapshots = False
        self.windows[incarnation] = self.windows.pop(incarnation, SequenceWindow())
        while len(self.windows) > _MAX_WINDOWS:
            del self.windows[next(iter(self.windows))]


class Fleet:
    """All actors of a run, and the spaces that they share."""

    def __init__(self, seed: int, spaces: Spaces | None) -> None:
        self._seed = seed
        self.spaces = spaces  # from the first actor or the checkpoint
        self.actors: dict[str, Actor] = {}  # joined actors, by name
        self.pushed_bytes = 0  # snapshots published so far, as sent to each subscriber
        self._present: dict[str, set[int]] = {}  # by name, the incarnations with a liveliness token

    def join(self, join: Join, now: float) -> Refusal | None:
        """Add an actor. Return None, or the Refusal if the actor cannot join.

        A new incarnation of a known name replaces the previous one if that is absent or quarantined. A Join without
        spaces only asks for the specification and changes nothing.

        Args:
          join: the message.
          now: time on the monotonic clock, in seconds.
        """
        try:
            keys.check_name(join.actor, "actor name")
        except ValueError as error:
            return Refusal(code="malformed", reason=str(error))
        known = self.actors.get(join.actor)
        if known is not None and known.incarnation != join.incarnation and self.is_live(known):
            return Refusal(
                code="name_taken",
                reason=f"actor name {join.actor!r} is already in use: choose another --name",
            )
        if known is not None and known.incarnation == join.incarnation and known.drained:
            return Refusal(code="drained", reason="an operator drained this actor")
        if join.spaces is None:
            return None
        if not 1 <= join.environments <= 4096:
            return Refusal(code="malformed", reason=f"environments is {join.environments}: it must be from 1 to 4096")
        if self.spaces is not None and join.spaces != self.spaces:
            return Refusal(
                code="mismatch",
                reason=f"the actor's environment has {join.spaces}, but this run has {self.spaces}: "
                "install the version of the environment that the other actors use",
            )
        if join.actor not in self.actors and not self._ensure_capacity():
            return Refusal(code="full", reason=f"{_MAX_ACTORS} actors have already joined")
        self.spaces = join.spaces
        actor = self.actors.setdefault(join.actor, Actor(join.actor))
        actor.last_seen = now
        if actor.incarnation != join.incarnation:
            actor.start_incarnation(join.incarnation)
        actor.environments = join.environments
        return None

    def drain(self, name: str) -> Refusal | None:
        """Ask an actor to leave after its current rollout. Return None, or a Refusal if it does not take part."""
        actor = self.actors.get(name)
        if actor is None or not self.is_present(actor):
            return Refusal(code="unknown", reason=f"no actor {name[:64]!r} takes part: `daedalus status` lists them")
        actor.drained = True
        return None

    def _ensure_capacity(self) -> bool:
        """Return whether one more actor can join. At capacity, evict the actor that has been absent longest."""
        if len(self.actors) < _MAX_ACTORS:
            return True
        absent = [actor for actor in self.actors.values() if not self.is_present(actor)]
        if absent:
            del self.actors[min(absent, key=lambda actor: actor.last_seen).name]
        return bool(absent)

    def seed_for(self, name: str, start_version: int) -> int:
        """Return the seed of an actor's environments and samples.

        It differs by name, by incarnation and by `start_version`, the policy version that the run continued from.
        """
        incarnations = self.actors[name].incarnations if name in self.actors else 0
        entropy = [self._seed, zlib.crc32(name.encode()), incarnations, start_version]
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def set_present(self, name: str, incarnation: int, present: bool) -> None:
        """Record whether the liveliness token of an incarnation is present."""
        if present:
            self._present.setdefault(name, set()).add(incarnation)
        elif name in self._present:
            self._present[name].discard(incarnation)
            if not self._present[name]:
                del self._present[name]

    def is_present(self, actor: Actor) -> bool:
        """Return whether the newest incarnation of an actor is present."""
        return actor.incarnation in self._present.get(actor.name, ())

    def is_live(self, actor: Actor) -> bool:
        """Return whether an actor is live: it has joined, is present and is not quarantined."""
        return self.is_present(actor) and actor.environments > 0 and not actor.quarantined

    def received(self, name: str, size: int) -> None:
        """Count `size` bytes received from an actor."""
        if name in self.actors:
            self.actors[name].received_bytes += size

    def find(self, identity: RolloutIdentity) -> Actor | None:
        """Return the actor of a rollout, or None if its incarnation is not the newest that has joined."""
        actor = self.actors.get(identity.actor)
        if actor is None or actor.incarnation != identity.incarnation or not actor.environments:
            return None
        return actor

    @property
    def live(self) -> frozenset[str]:
        """Names of the live actors. A synchronous batch waits for all of them."""
        return frozenset(actor.name for actor in self.actors.values() if self.is_live(actor))

    def statuses(self, now: float) -> tuple[ActorStatus, ...]:
        """Return the status of each actor, sorted by name. `now` is on the monotonic clock, in seconds."""
        return tuple(
            ActorStatus(
                actor=actor.name,
                alive=self.is_present(actor),
                quarantined=actor.quarantined,
                lives=actor.incarnations,
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
