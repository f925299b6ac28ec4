"""The actors as the learner knows them: who takes part, with which identity, how they fare. State, no I/O.

The service owns the lock that guards it.
"""

import zlib
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from protocol.messages import Join, Refusal, RolloutIdentity
from protocol.spec import ActorStatus, Spaces

_REMEMBERED_LIVES = 8
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
    present: bool = False
    last_seen: float = 0.0
    windows: dict[int, SequenceWindow] = field(default_factory=dict)  # by incarnation, the newest last
    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    env_steps: int = 0
    policy_lag: int = 0  # of its newest rollout

    @property
    def sequences(self) -> SequenceWindow:
        """What was taken of its newest incarnation."""
        return self.windows[self.incarnation]


class Fleet:
    """All actors of a run, and the spaces they must share."""

    def __init__(self, seed: int, spaces: Spaces | None) -> None:
        self._seed = seed
        self.spaces = spaces  # the first actor's, or those of the checkpoint
        self.actors: dict[str, Actor] = {}

    def join(self, join: Join, now: float) -> Refusal | None:
        """Takes in an actor; returns why not, if it cannot take part.

        A new incarnation of a known name replaces the old one. Who comes without spaces only asks what is played.
        """
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
        self.spaces = join.spaces
        actor = self._actor(join.actor)
        actor.last_seen = now
        if actor.incarnation != join.incarnation:
            actor.incarnation = join.incarnation
            actor.lives += 1
            # A life that comes back, after another that used its name, has what it sent remembered.
            actor.windows[join.incarnation] = actor.windows.pop(join.incarnation, SequenceWindow())
            while len(actor.windows) > _REMEMBERED_LIVES:
                del actor.windows[next(iter(actor.windows))]
        actor.environments = join.environments
        return None

    def seed_for(self, name: str, start_version: int) -> int:
        """The seed of an actor's environments and samples: its own for each life of it, and after each resume."""
        lives = self.actors[name].lives if name in self.actors else 0
        entropy = [self._seed, zlib.crc32(name.encode()), lives, start_version]
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def set_present(self, name: str, present: bool) -> None:
        """What liveliness says of an actor."""
        self._actor(name).present = present

    def expected(self, identity: RolloutIdentity) -> Actor | None:
        """The actor a rollout is from, or None if that life of it has not joined."""
        actor = self.actors.get(identity.actor)
        if actor is None or actor.incarnation != identity.incarnation or not actor.environments:
            return None
        return actor

    @property
    def live(self) -> frozenset[str]:
        """The names of those that are present and joined: the ones a synchronous batch waits for."""
        return frozenset(actor.name for actor in self.actors.values() if actor.present and actor.environments)

    def statuses(self, now: float) -> tuple[ActorStatus, ...]:
        """One line for each actor, by name."""
        return tuple(
            ActorStatus(
                actor=actor.name,
                alive=actor.present and actor.environments > 0,
                seconds_since_seen=max(now - actor.last_seen, 0.0),
                environments=actor.environments,
                rollouts_accepted=actor.accepted,
                rollouts_rejected=dict(actor.rejected),
                env_steps=actor.env_steps,
                policy_lag=actor.policy_lag,
            )
            for actor in sorted(self.actors.values(), key=lambda actor: actor.name)
        )

    def _actor(self, name: str) -> Actor:
        return self.actors.setdefault(name, Actor(name))
