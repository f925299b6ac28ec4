"""What happened to each rollout, and the invariants of the protocol."""

from collections import Counter
from collections.abc import Set
from dataclasses import dataclass, field

from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.rollout_buffer import TakenRollouts
from daedalus.learner.serving.rollout_judge import Rejected
from daedalus.protocol.messages import Acknowledgement, Snapshot
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity, Upload

from .kernel import Kernel

_BASE = 128  # numbers below 257 survive the bfloat16 of compact snapshots


class Violation(Exception):  # noqa: N818 - the usual word
    """An invariant does not hold."""


@dataclass(slots=True)
class Life:
    """One life of the learner, from its start to its end."""

    number: int  # from 0
    epoch: int
    added: dict[RolloutIdentity, None] = field(default_factory=dict)  # to the buffer
    trained: dict[RolloutIdentity, None] = field(default_factory=dict)
    stale: dict[RolloutIdentity, None] = field(default_factory=dict)  # in the buffer
    judged: dict[RolloutIdentity, None] = field(default_factory=dict)
    answers: dict[RolloutIdentity, Counter[str]] = field(default_factory=dict)
    published: dict[int, float] = field(default_factory=dict)  # when, by version
    ended: bool = False

    def has_verdict(self, identity: RolloutIdentity) -> bool:
        """Return whether the learner has decided about a rollout."""
        return identity in self.judged or bool(self.answers.get(identity, Counter()).keys() - {"busy"})


class Ledger:
    """Record of one simulation."""

    def __init__(self, kernel: Kernel, spec: RunSpec) -> None:
        self._kernel, self._spec = kernel, spec
        self.is_finished = False  # whether the budget of the run is used up
        self.lives: list[Life] = []
        self.collected: list[RolloutIdentity] = []  # by the number that each rollout carries
        self._numbers: dict[RolloutIdentity, int] = {}
        self.freshest: dict[
            str, float
        ] = {}  # by actor: when the newest policy was published that it was trained on with

    def require(self, holds: bool, *facts: object) -> None:
        """Raise Violation with these facts, and end the simulation, unless something holds."""
        if not holds:
            error = Violation(" ".join(map(str, facts)))
            self._kernel.log("VIOLATION", *facts)
            self._kernel.fail(error)
            raise error

    # ------------------------------------------------------------------------------------------------ weights

    @staticmethod
    def token(life: int, version: int) -> list[float]:
        """Return the weights of a policy version: numbers that say which life of the learner made it."""
        return [float(life), float(version // _BASE), float(version % _BASE)]

    def begin_life(self, epoch: int, version: int) -> Life:
        """Note the start of a learner with a policy version."""
        self.lives.append(Life(len(self.lives), epoch, published={version: self._kernel.now}))
        return self.lives[-1]

    # ------------------------------------------------------------------------------------------------- actors

    def used(self, snapshot: Snapshot, epoch: int) -> None:
        """Check a snapshot that an actor collects with in its session with a learner of an epoch."""
        self.require(snapshot.learner_epoch == epoch, "an actor loads a snapshot of another learner epoch")
        life = next(life for life in self.lives if life.epoch == epoch)
        weights, version = snapshot.weights["w"].tolist(), snapshot.policy_version
        self.require(weights == self.token(life.number, version), "version", version, "has the weights", weights)

    def collect(self, identity: RolloutIdentity) -> int:
        """Note a new rollout, and return the number that it carries."""
        self.require(identity not in self._numbers, "two rollouts have one identity:", identity)
        self._numbers[identity] = len(self.collected)
        self.collected.append(identity)
        self._kernel.log("collect", identity.actor, identity.incarnation, identity.sequence)
        return self._numbers[identity]

    # ------------------------------------------------------------------------------------------------ learner

    def judged(self, life: Life, rollout: Rollout, verdict: Upload | Rejected, incarnation: int) -> None:
        """Check the verdict on a rollout; `incarnation` is the newest of its actor that has joined."""
        identity = rollout.identity
        if verdict is rollout:
            is_current = identity.incarnation == incarnation
            self.require(is_current, "a rollout of an earlier incarnation is accepted:", identity)
        life.judged[identity] = None

    def answered(self, life: Life, identity: RolloutIdentity, answer: Acknowledgement) -> None:
        """Check an answer on its way to an actor."""
        verdicts = life.answers.setdefault(identity, Counter())
        verdicts[answer.verdict] += 1
        self._kernel.log("answer", identity.actor, identity.sequence, answer.verdict, answer.reason)
        if answer.verdict == "accepted":
            self.require(identity in life.added, "answered accepted, but not in the buffer:", identity)
            self.require(verdicts["accepted"] == 1, "accepted twice:", identity)
        self.require(answer.verdict != "quarantined", "an honest actor is quarantined:", answer.reason)
        is_known = answer.policy_version == 0 or answer.policy_version in life.published
        self.require(is_known, "an answer mentions a version that was not published:", answer.policy_version)

    def added(self, life: Life, rollout: Rollout) -> None:
        """Check a rollout that is put into the buffer."""
        identity = rollout.identity
        self.require(identity not in life.added, "put into the buffer twice:", identity)
        life.added[identity] = None
        self._kernel.log("accept", identity.actor, identity.sequence, rollout.policy_version)
        self.require(identity.learner_epoch == life.epoch, "a rollout of another epoch is accepted:", identity)
        *weights, number = rollout.frames["observation"][0, 0].tolist()
        is_right = weights == self.token(life.number, rollout.policy_version)
        self.require(is_right, identity, "claims version", rollout.policy_version, "but its weights were", weights)
        self.require(self._numbers.get(identity) == int(number), "carries another rollout's content:", identity)

    def took(self, life: Life, taken: TakenRollouts, version: int, awaited: Set[str]) -> None:
        """Check what is taken out of the buffer; a synchronous batch waits for the `awaited` actors."""
        for rollout in taken.stale:
            self.require(rollout.identity not in life.stale, "stale twice:", rollout.identity)
            life.stale[rollout.identity] = None
        if not taken.rollouts:
            return
        synchronous = self._spec.algorithm.synchronous
        bound = 0 if synchronous else self._spec.policy_lag_bound_with(0)
        for rollout in taken.rollouts:
            identity, lag = rollout.identity, version - rollout.policy_version
            self.require(identity not in life.trained, "trained twice:", identity)
            self.require(identity in life.added and identity not in life.stale, "was not accepted:", identity)
            self.require(0 <= lag <= bound, identity, "has a policy lag of", lag, "and the bound is", bound)
            life.trained[identity] = None
            published = life.published[rollout.policy_version]
            self.freshest[identity.actor] = max(published, self.freshest.get(identity.actor, 0.0))
        names = [rollout.identity.actor for rollout in taken.rollouts]
        self._kernel.log("train", version, *names)
        if synchronous:
            self.require(len(set(names)) == len(names), "a batch has two rollouts of one actor:", names)
            self.require(awaited <= set(names), "a batch misses a live actor:", names, "of", sorted(awaited))

    def check_counts(self, life: Life, accepted: int, trained: int, waiting: int) -> None:
        """Check the learner's counters, and that accepted = trained + stale + waiting in the buffer."""
        added, taken, stale = len(life.added), len(life.trained), len(life.stale)
        balance = accepted, "accepted,", added, "put into the buffer,", trained, "trained,", taken, "taken"
        self.require((accepted, trained) == (added, taken), "a counter is wrong:", *balance)
        balance = *balance, stale, "stale,", waiting, "waiting"
        self.require(accepted == trained + stale + waiting, "accepted is not trained + stale + waiting:", *balance)


def observe(server: ActorServer, ledger: Ledger, life: Life) -> None:
    """Note every verdict, and every rollout that is put into the buffer and taken out of it."""
    judge, buffer = server.rollouts._judge, server.rollouts._buffer
    decide, add, take = judge.decide, buffer.add, buffer.take

    def noted_decide(
        sender: str, content: Upload | Rejected, policy_version: int, now: float, *, surplus: bool = False
    ) -> Upload | Rejected:
        verdict = decide(sender, content, policy_version, now, surplus=surplus)
        if isinstance(content, Rollout):
            ledger.judged(life, content, verdict, server.context.fleet.actors[sender].incarnation)
        return verdict

    def noted_add(rollout: Rollout) -> None:
        ledger.added(life, rollout)
        add(rollout)

    def noted_take(live: Set[str], policy_version: int, now: float, *, complete: bool = True) -> TakenRollouts:
        taken = take(live, policy_version, now, complete=complete)
        ledger.took(life, taken, policy_version, live - buffer.left_out)
        return taken

    judge.decide = noted_decide  # type: ignore[method-assign]
    buffer.add, buffer.take = noted_add, noted_take  # type: ignore[method-assign]
