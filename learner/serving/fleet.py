"""The actors of a run: joins, presence, incarnations. No I/O.

An actor that is absent for a minute is forgotten; the totals of the run keep its counts. What is remembered of it
longer, so that no rollout is trained on twice, is in FormerIncarnations.

The lock of the run guards all of it.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from daedalus.learner.serving.actor_state import Actor
from daedalus.learner.serving.refused_joins import RefusedJoins, bounded
from daedalus.protocol import keys
from daedalus.protocol.messages import MAX_ENVIRONMENTS, ClientReport, Join, Refusal
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.texts import bounded_text
from daedalus.protocol.uploads import RolloutIdentity

_MAX_TOKENS = 8192  # tokens: twice the actors that one owner may have


class Presence:
    """Set of present incarnations. The number of one owner is bounded: further ones do not count as present."""

    def __init__(self) -> None:
        self._present: set[tuple[str, int]] = set()
        self._of_owner: Counter[str] = Counter()

    def __contains__(self, incarnation: tuple[str, int]) -> bool:
        return incarnation in self._present

    def set(self, name: str, incarnation: int, present: bool) -> None:
        """Record whether the token of an incarnation of the actor `name` is present."""
        key, owner = (name, incarnation), keys.owner(name)
        if present and key not in self._present and self._of_owner[owner] < _MAX_TOKENS:
            self._present.add(key)
            self._of_owner[owner] += 1
        elif not present and key in self._present:
            self._present.remove(key)
            self._of_owner[owner] -= 1
        if not self._of_owner[owner]:
            del self._of_owner[owner]


_MAX_FORMER = 65_536  # 20 MB; 50 MB if all were quarantined


@dataclass(frozen=True, slots=True, kw_only=True)
class Former:
    """One incarnation of an actor that was forgotten or replaced."""

    next_sequence: int = 0  # all numbers below were received or given up
    replaced: bool = False  # whether another incarnation joined under the name: this one cannot join again
    quarantined: str = ""  # the reason, if it was quarantined


_UNKNOWN = Former()


class FormerIncarnations:
    """Record of former incarnations, so that none of their rollouts is accepted a second time.

    An incarnation that was replaced never becomes current again, and one that was forgotten continues above the highest
    sequence number that was received from it. The record is bounded: the oldest entry makes room for the newest. What
    protects from a second use of its rollouts is then the bound on the policy lag alone.
    """

    def __init__(self) -> None:
        self._former: dict[tuple[str, int], Former] = {}  # by name and incarnation, the newest entry last

    def __getitem__(self, key: tuple[str, int]) -> Former:
        return self._former.get(key, _UNKNOWN)

    def __len__(self) -> int:
        return len(self._former)

    def add(self, name: str, incarnation: int, former: Former) -> None:
        """Remember an incarnation of the actor `name`."""
        self._former.pop((name, incarnation), None)
        while len(self._former) >= _MAX_FORMER:
            del self._former[next(iter(self._former))]
        self._former[name, incarnation] = former


_MAX_ACTORS = 16_384
# Environments that an actor may state: the larger of a number and a multiple of what the run expects.
_FEW_ENVIRONMENTS, _TIMES_EXPECTED = 256, 8
_MAX_OF_ONE_OWNER = 4096  # so that one certificate cannot fill the fleet
_FORGET_SECONDS = 60.0  # of absence
_EPSILON = 1  # distinguishes this draw from others by the same seed and name
_SWEEP_SECONDS = 1.0  # between searches for actors to forget


def _number(name: str) -> int:
    """Return 128 bits of a name's digest: a shorter one would give some names the same random numbers."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:16])


class Fleet:
    """All actors of a run, and the spaces that they share."""

    def __init__(
        self, seed: int, spaces: Spaces | None, epsilons: Sequence[float] = (0.0,), expected_environments: int = 1
    ) -> None:
        """Construct an empty fleet.

        Args:
          seed: of the run.
          spaces: of the environment, if they are known before the first actor.
          epsilons: those that actors draw theirs from.
          expected_environments: of each actor, by the settings of the run.
        """
        self._seed, self._epsilons = seed, epsilons
        self._most_environments = min(max(_FEW_ENVIRONMENTS, _TIMES_EXPECTED * expected_environments), MAX_ENVIRONMENTS)
        self.spaces = spaces  # known before, or from the first actor
        self.actors: dict[str, Actor] = {}  # joined actors, by name
        self.pushed_bytes = 0  # snapshots published so far, as sent to each subscriber
        self.forgotten = 0  # number of actors that were forgotten
        self.forgotten_missed = 0  # rollouts of forgotten actors that never arrived
        self.forgotten_busy = 0  # `busy` answers to forgotten actors
        self.refused_joins = RefusedJoins()
        self._presence = Presence()
        self._former = FormerIncarnations()
        self._of_owner: Counter[str] = Counter()  # number of actors
        self._sweep_at = 0.0
        self._live: frozenset[str] | None = None  # None: not known since the last change

    # ------------------------------------------------------------------------------------------------- joining

    def join(self, join: Join, now: float) -> Refusal | None:
        """Add an actor. Return None, or the Refusal if the actor cannot join.

        A new incarnation of a known name replaces the previous one if that is absent or quarantined; the previous one
        can never join again. A Join without spaces only asks for the specification and changes nothing.

        Args:
          join: the message.
          now: time on the monotonic clock, in seconds.
        """
        self.forget_absent(now)
        refusal = self._check_identity(join)
        if refusal is not None or join.spaces is None:
            return refusal
        if not 1 <= join.environments <= self._most_environments:
            reason = f"environments is {join.environments}: in this run it must be from 1 to {self._most_environments}"
            if 1 <= join.environments <= MAX_ENVIRONMENTS:
                reason += f", the larger of {_FEW_ENVIRONMENTS} and {_TIMES_EXPECTED} x collection.envs_per_actor"
            return Refusal(code="malformed", reason=reason)
        if self.spaces is not None and join.spaces != self.spaces:
            return Refusal(
                code="mismatch",
                reason=f"the actor's environment has {join.spaces}, but this run has {self.spaces}: "
                "install the version of the environment that the run uses, or give a client the spaces of the run",
            )
        if join.actor not in self.actors:
            reason = self._make_room(keys.owner(join.actor))
            if reason:
                return Refusal(code="full", reason=reason)
            epsilon = self.epsilon_for(join.actor)
            self.actors[join.actor] = Actor(join.actor, forgotten_before=self.forgotten, epsilon=epsilon)
            self._of_owner[keys.owner(join.actor)] += 1
        self.spaces = self.spaces or join.spaces  # equal ones may have their components in another order
        self.refused_joins.joined(join.actor)
        actor = self.actors[join.actor]
        actor.last_seen = now
        if actor.incarnation != join.incarnation:
            self._replace_incarnation(actor, join.incarnation)
            actor.joined = now
        actor.environments, actor.origin = join.environments, bounded(join.origin)
        self.changed()
        return None

    def report(self, name: str, report: ClientReport, now: float) -> Refusal | None:
        """Note what an actor reports about itself. Return None, or a Refusal if it does not take part.

        `now` is on the monotonic clock, in seconds.
        """
        actor = self.actors.get(name)
        if actor is None or (report.actor, report.incarnation) != (name, actor.incarnation):
            return Refusal(code="unknown", reason=f"this process of {name[:64]!r} has not joined")
        actor.report = replace(report, safe_reason=bounded_text(report.safe_reason))
        actor.heard(now)
        return None

    def drain(self, name: str, author: str) -> Refusal | None:
        """Ask an actor to leave after its current rollout. Return None, or a Refusal if it does not take part."""
        actor = self.actors.get(name)
        if actor is None or not self.is_present(actor):
            return Refusal(code="unknown", reason=f"no actor {name[:64]!r} takes part: `daedalus status` lists them")
        actor.drained_by = actor.drained_by or author
        return None

    def _check_identity(self, join: Join) -> Refusal | None:
        """Return the Refusal if this incarnation of the actor cannot take part."""
        try:
            keys.check_name(join.actor, "actor name")
        except ValueError as error:
            return Refusal(code="malformed", reason=str(error))
        known, former = self.actors.get(join.actor), self._former[join.actor, join.incarnation]
        if known is not None and known.incarnation == join.incarnation:
            return Refusal(code="drained", reason=f"drained by {known.drained_by}") if known.drained_by else None
        if former.quarantined:
            return Refusal(code="malformed", reason=f"this process was quarantined: {former.quarantined}; restart it")
        if former.replaced:
            reason = f"another process has joined as {join.actor!r} since: restart this one, or choose another --name"
            return Refusal(code="name_taken", reason=reason)
        if known is not None and self.is_live(known):
            reason = f"actor name {join.actor!r} is already in use: choose another --name"
            return Refusal(code="name_taken", reason=reason)
        return None

    def _replace_incarnation(self, actor: Actor, incarnation: int) -> None:
        if actor.incarnations:
            self._former.add(actor.name, actor.incarnation, Former(replaced=True))
        actor.start_incarnation(incarnation, self._former[actor.name, incarnation].next_sequence)

    def _make_room(self, owner: str) -> str:
        """Forget the actor that has been absent longest if there is no room for another actor of an owner.

        Return an empty string, or why there is no room.
        """
        candidates: Iterable[Actor] = self.actors.values()
        if self._of_owner[owner] >= _MAX_OF_ONE_OWNER:
            candidates = [actor for actor in candidates if keys.owner(actor.name) == owner]
            reason = f"{_MAX_OF_ONE_OWNER} actors have already joined as {owner!r} or {owner}.ANYTHING"
        elif len(self.actors) >= _MAX_ACTORS:
            reason = f"{_MAX_ACTORS} actors have already joined"
        else:
            return ""
        absent = [actor for actor in candidates if not self.is_present(actor)]
        if not absent:
            return reason
        self._forget(min(absent, key=lambda actor: actor.last_seen))
        return ""

    def incarnation_number(self, name: str) -> int:
        """Return a number that is different for each incarnation that joins under a name."""
        return self.actors[name].incarnation_number if name in self.actors else 0

    def seed_for(self, name: str, start_version: int) -> int:
        """Return the seed of an actor's environments and samples.

        It differs by name, by incarnation and by `start_version`, the policy version that the run continued from.
        """
        entropy = [self._seed, _number(name), self.incarnation_number(name), start_version]
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def epsilon_for(self, name: str) -> float:
        """Return the final epsilon of an actor: drawn by the run's seed and the name, the same in every incarnation."""
        random = np.random.default_rng([self._seed, _number(name), _EPSILON])
        return self._epsilons[int(random.integers(len(self._epsilons)))]

    # ---------------------------------------------------------------------------------------------- forgetting

    def forget_absent(self, now: float) -> None:
        """Forget the actors that have been absent for a minute. `now` is on the monotonic clock, in seconds."""
        if now < self._sweep_at:
            return
        self._sweep_at = now + _SWEEP_SECONDS
        for actor in list(self.actors.values()):
            if now - actor.last_seen > _FORGET_SECONDS and not self.is_present(actor):
                self._forget(actor)

    def _forget(self, actor: Actor) -> None:
        owner = keys.owner(actor.name)
        del self.actors[actor.name]
        self._of_owner[owner] -= 1
        if not self._of_owner[owner]:
            del self._of_owner[owner]
        actor.sequences.give_up()
        former = Former(next_sequence=actor.sequences.low, quarantined=actor.quarantined)
        self._former.add(actor.name, actor.incarnation, former)
        self.forgotten += 1
        self.forgotten_missed = min(self.forgotten_missed + actor.missed, 2**53)
        self.forgotten_busy += actor.busy
        self.changed()

    # ------------------------------------------------------------------------------------------------ presence

    def set_present(self, name: str, incarnation: int, present: bool, now: float) -> bool:
        """Record whether an incarnation is present; return whether an actor that has joined left or returned.

        `now` is on the monotonic clock, in seconds.
        """
        self._presence.set(name, incarnation, present)
        actor = self.actors.get(name)
        if actor is None or actor.incarnation != incarnation:
            return False
        actor.last_seen = now
        self.changed()
        changed, actor.left = actor.left == present, not present  # its token may come after its Join
        return changed

    def is_present(self, actor: Actor) -> bool:
        """Return whether the newest incarnation of an actor is present."""
        return (actor.name, actor.incarnation) in self._presence

    def is_live(self, actor: Actor) -> bool:
        """Return whether an actor is live: it has joined, is present and is not quarantined."""
        return self.is_present(actor) and actor.environments > 0 and not actor.quarantined

    @property
    def live(self) -> frozenset[str]:
        """Names of the live actors. A synchronous batch waits for all of them."""
        if self._live is None:
            self._live = frozenset(actor.name for actor in self.actors.values() if self.is_live(actor))
        return self._live

    def batch_seconds(self, rollouts: int, *, together: bool) -> float:
        """Return how long the live actors take for a batch, in seconds, as far as they report it; else 0.

        Args:
          rollouts: number of rollouts in a batch.
          together: whether a batch is one rollout of each actor.
        """
        reports = filter(None, (self.actors[name].report for name in self.live))
        seconds = [each.rollout_seconds + each.waiting_seconds for each in reports if each.rollout_seconds > 0.0]
        if together or not seconds:
            return max(seconds, default=0.0)
        return rollouts / sum(1.0 / each for each in seconds)

    def changed(self) -> None:
        """Note that the live actors may be others than before, for example after a quarantine."""
        self._live = None

    # ------------------------------------------------------------------------------------------------ rollouts

    def received(self, name: str, size: int) -> None:
        """Count `size` bytes received from an actor."""
        if name in self.actors:
            self.actors[name].received_bytes += size

    @property
    def has_had_actors(self) -> bool:
        """Whether an actor has joined, now or before."""
        return bool(self.actors) or self.forgotten > 0

    def find(self, identity: RolloutIdentity) -> Actor | None:
        """Return the actor of a rollout, or None if its incarnation is not the newest that has joined."""
        actor = self.actors.get(identity.actor)
        if actor is None or actor.incarnation != identity.incarnation or not actor.environments:
            return None
        return actor
