"""The messages of the protocol, as frozen dataclasses; uploads.py has those with rollouts.

Shapes are checked at construction, so an inconsistent message can neither be sent nor decoded. codec.py encodes
messages, keys.py names the keys that they use, and the learner's intake decides which it accepts.
"""

import hashlib
import math
import secrets
from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydantic import Field

from daedalus.protocol import keys
from daedalus.protocol.league import LeagueStatus, Plan
from daedalus.protocol.lessons import LessonPlan
from daedalus.protocol.models import Specification
from daedalus.protocol.spaces import ComponentOrder, Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.texts import MAX_NAME, bounded_text
from daedalus.protocol.uploads import EPISODE_DTYPES, Gradient, Rollout


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientReport:
    """What one process of an actor counts and measures. Actor -> learner, on `reports/{actor}`.

    An actor sends it every few seconds while the counts change: a sign of life between two rollouts of a slow
    environment. The answer is an Acknowledgement or a Refusal.
    """

    actor: str
    incarnation: int
    rows: int = 0  # that it has begun so far; each is a step of all its environments
    # Durations of the newest rollouts, in seconds; 0 before they are known.
    rollout_seconds: float = 0.0  # to play one
    waiting_seconds: float = 0.0  # from one to the next: for the learner, the network and newer snapshots
    round_trip_seconds: float = 0.0  # until the answer to a small request of this actor
    processor_share: float = 0.0  # of one processor, by this process alone
    memory_bytes: int = 0  # of this process in RAM; 0 if it is unknown
    # Of a client, whose loop its user owns:
    deadlines: int = 0  # of its clock; 0 without a clock
    missed_deadlines: int = 0
    overridden_actions: int = 0  # of a person or a safety filter, played in place of the policy's
    safe_actions: int = 0  # played because the policy was too old or untrained
    rollouts_dropped: int = 0  # finished or not, that were never sent
    safe_reason: str = ""  # why it plays the safe action now; empty while the policy acts

    def __post_init__(self) -> None:
        for name in ("rollout_seconds", "waiting_seconds", "round_trip_seconds", "processor_share"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be 0 or more")


Order = Literal["stop", "checkpoint", "drain"]


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderRequest:
    """Order of an operator to one process, on `orders/{operator}`.

    Operator -> learner, which answers with an Acknowledgement `accepted` or a Refusal; it carries an order out once,
    and only if the order names its run and its epoch. Operator -> actors that wait for a run, as a publication: the
    actor of that name and incarnation leaves.

    stop: save a checkpoint and end; the run can be resumed.
    checkpoint: save a checkpoint now.
    drain: ask an actor to leave after its current rollout.
    """

    order: Order
    run: str = ""  # of the learner
    learner_epoch: int = 0  # likewise
    number: int = 0  # at random: no other order to this learner has it
    actor: str = ""  # that is drained
    incarnation: int = 0  # of an actor that waits for a run
    # Who gives the order, besides the operator's name in the key, as the sender states it.
    host: str = ""
    token: str = ""  # whose token the page of a gateway sent, such as `operator alice`; empty if it is not from a page

    def author(self, operator: str) -> str:
        """Return who gives the order, for a person; `operator` is the name in the key."""
        host = f" at {bounded_text(self.host, MAX_NAME)}" if self.host else ""
        named = operator != keys.NO_OPERATOR
        if self.token:
            gateway = f" of operator {bounded_text(operator, MAX_NAME)}" if named else ""
            return f"the token of {bounded_text(self.token, 2 * MAX_NAME)}, on the page of the gateway{gateway}{host}"
        if named:
            return f"operator {bounded_text(operator, MAX_NAME)}{host}"
        return f"the operator{host}, without an operator's certificate"


MAX_PAGE_VALUES = 1 << 16  # numbers in one page


class MetricsPage(Specification):
    """What the numbers of a MetricsReport mean."""

    run: str
    learner_epoch: int
    columns: tuple[str, ...]  # names of the metrics, as in metrics.csv


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricsRequest:
    """Request of an operator for rows of the metrics. Operator -> learner, on `status`."""

    first: int  # number of the first row wanted; 0: from the begin of the run


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MetricsReport:
    """The next rows of the metrics, in answer to a MetricsRequest; no rows after the newest.

    The learner keeps a bounded number of rows of the whole run. Therefore numbers are missing among older rows.
    """

    page: MetricsPage
    numbers: np.ndarray  # [rows] int64, increasing
    values: np.ndarray  # [rows, columns] float64; NaN where a row has no value

    def __post_init__(self) -> None:
        if self.numbers.ndim != 1 or self.numbers.dtype != np.int64:
            raise ValueError(f"numbers must be int64 [rows], not {self.numbers.dtype} {self.numbers.shape}")
        shape = (len(self.numbers), len(self.page.columns))
        if self.values.shape != shape or self.values.dtype != np.float64:
            raise ValueError(f"values must be float64 {list(shape)}, not {self.values.dtype} {self.values.shape}")


# Learner epochs have 62 bits: the upper 22 count the starts of a run's learner and the lower 40 are random. A learner
# that resumes from a checkpoint has a larger epoch than each learner before that checkpoint, whatever the clocks of
# their hosts say. Of two learners of one run, the one with the larger epoch is the newer: so a run that was continued
# from a copy goes on there, and not where it was copied from.
_RANDOM_BITS = 40
_MOST_STARTS = (1 << 22) - 1


def new_epoch(starts: int) -> int:
    """Return an epoch for the learner process number `starts` of a run; the first is 1."""
    return min(starts, _MOST_STARTS) << _RANDOM_BITS | secrets.randbits(_RANDOM_BITS)


def starts_of(epoch: int) -> int:
    """Return how many learner processes the run had, as far as the learner with this epoch knows."""
    return epoch >> _RANDOM_BITS


MAX_EVENTS = 100  # that a learner keeps
PAGE_ACTORS = 60  # in one answer, so that it stays within the reader's limits whatever the size of the fleet


class ActorStatus(Specification):
    """State of one actor."""

    actor: str
    host: str  # where it runs, what it runs and its address, as the actor states them
    software: str
    address: str
    alive: bool
    quarantined: str  # why its rollouts are no longer accepted; empty if they are
    lives: int  # incarnations that joined
    seconds_since_seen: float
    environments: int
    epsilon: float  # the probability with which it takes a random action in the end; 0: it does not explore
    env_steps: int  # that were trained on
    env_steps_per_second: float
    rollouts_accepted: int
    rollouts_rejected: dict[str, int]  # by cause
    rollouts_missed: int  # sequence numbers that never arrived
    busy_answers: int  # how often the learner answered busy
    policy_lag: int  # of its newest rollout, in updates
    compact_snapshots: bool  # it requests compact snapshots, not whole ones
    bytes_up_per_hour: float  # of rollouts, at the rate of the last seconds
    bytes_down_per_hour: float  # of snapshots
    # What a client reports of its newest process (protocol/messages.py); 0 and empty for any other actor.
    deadlines: int = 0
    missed_deadlines: int = 0
    overridden_actions: int = 0
    safe_actions: int = 0
    rollouts_dropped: int = 0
    safe_reason: str = ""
    # What any actor reports of its newest process; 0 if it is unknown.
    rows: int = 0
    rollout_seconds: float = 0.0
    waiting_seconds: float = 0.0
    round_trip_seconds: float = 0.0
    processor_share: float = 0.0
    memory_bytes: int = 0
    silence_limit_seconds: float = 60.0  # `seconds_since_seen` above it is unusual for this actor
    drained_by: str = ""  # who ordered it to leave; empty if nobody did

    @property
    def busy_share(self) -> float:
        """Share of the learner's answers that were busy."""
        answers = self.rollouts_accepted + sum(self.rollouts_rejected.values()) + self.busy_answers
        return self.busy_answers / max(answers, 1)


class RefusedJoin(Specification):
    """Joins that were refused for the same reason, and failures that actors of one host reported."""

    actor: str  # that was refused last
    host: str  # as the actor states it; empty if it is not known
    software: str  # likewise, or the protocol version if it is not this learner's
    reason: str
    count: int
    seconds_since_last: float


EventKind = Literal[
    "started", "joined", "left", "refused", "failed", "rejected", "quarantined", "target", "checkpoint", "ended"
]


class Event(Specification):
    """One event of a run, or several equal ones within a minute."""

    time: str  # of the first, by the learner's clock: ISO 8601, UTC
    kind: EventKind
    actor: str  # that the event is about; empty if it is about the run
    text: str
    count: int


class EventsPage(Specification):
    """The newest events of one learner process (MAX_EVENTS), the newest last."""

    run: str
    learner_epoch: int
    events: tuple[Event, ...]


class ActorsPage(Specification):
    """Part of the list of all actors, sorted by name."""

    learner_epoch: int
    actors: tuple[ActorStatus, ...]


class RunStatus(Specification):
    """State of a run and its actors. The answer to a `status` query has the first actors only (PAGE_ACTORS)."""

    run: str
    learner_epoch: int
    algorithm: str
    environment: str
    problems: tuple[str, ...]  # reasons why the service is not healthy; empty if it is
    uptime_seconds: float  # of this learner process
    env_steps: int
    env_steps_budget: int
    updates: int
    updates_skipped: int  # number of updates skipped because the gradient was not finite
    episode_return_mean: float | None
    env_steps_per_second: float
    updates_per_second: float
    policy_lag_mean: float
    queue_bytes: int  # of rollouts that wait to be decoded
    queue_bytes_limit: int
    checkpoint_age_seconds: float | None  # None before the first checkpoint of this process
    certificate_days_left: float | None  # of the learner's certificate; None without one
    rollouts_accepted: int
    rollouts_rejected: dict[str, int]  # by cause, including senders that never joined
    rollouts_missed: int  # sequence numbers that never arrived
    busy_answers: int  # how often the learner answered busy
    actors_alive: int
    actors_quarantined: int  # present, but their rollouts are no longer accepted
    actors_gone: int  # absent for less than a minute; later they are forgotten, and only the totals above include them
    refused_joins: tuple[RefusedJoin, ...]  # of the last hour, the newest last
    actors: tuple[ActorStatus, ...]  # sorted by name
    updates_per_batch: int = 1  # by which a policy lag in updates is one in batches
    processor_share: float = 0.0  # of one processor, by the learner's process; memory_bytes is its size in RAM
    memory_bytes: int = 0
    agent_steps: int | None = None  # learned from, of the agents of a game; None: one agent acts in each env_step
    bottleneck: str = ""  # what the run waits for, in one line for a person; empty if it is not known yet
    learning_share: float = 0.0  # of the time in which the learner computes updates
    decoding_share: float = 0.0  # of the time in which the learner decodes rollouts
    last_order: str = ""  # the newest order of an operator to this process, its author and time; empty without one
    league: LeagueStatus | None = None  # of a game with opponents, bounded (LeagueStatus.bounded)
    lessons: dict[str, str] = Field(default_factory=dict)  # by parameter: what is played now, for a person
    software: str = ""  # release of the learner, such as `daedalus-rl 1.2.3`

    @property
    def releases(self) -> dict[str, tuple[int, int]]:
        """By release: how many learners (0 or 1) and actors that are present have it. Empty text: it is not known."""
        actors = Counter(actor.software for actor in self.actors if actor.alive)
        names = dict.fromkeys([self.software, *sorted(actors)])
        return {name: (int(name == self.software), actors[name]) for name in names}

    @property
    def fleet_size(self) -> int:
        """Number of actors of the run, on whatever page they are."""
        return self.actors_alive + self.actors_quarantined + self.actors_gone


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Where an actor runs, as the actor states it: for an operator who reads the status. Each text may be empty."""

    host: str = ""  # name of the host
    software: str = ""  # name and version, such as `daedalus-rl 1.2.3`
    address: str = ""  # of the actor's end of the connection, such as `tcp/10.0.0.7:43092`


UNKNOWN = Origin()


MAX_ENVIRONMENTS = 4096  # of one actor


@dataclass(frozen=True, slots=True, kw_only=True)
class Join:
    """Request of an actor to join. Actor -> learner, on `join`.

    Sent twice: first without spaces, to receive the specification of the run; then with the spaces of the environment
    that the actor made from the specification. An actor that fails sends it a last time, with the reason.
    """

    actor: str  # a name that stays the same across restarts
    incarnation: int  # identifies this process of the actor
    spaces: Spaces | None = None
    environments: int = 0  # E, number of vectorised environments
    origin: Origin = UNKNOWN
    failure: str = ""  # why the actor fails and ends, such as a missing module; empty if it asks to join


@dataclass(frozen=True, slots=True, kw_only=True)
class Welcome:
    """Specification that an actor needs. Learner -> actor, in answer to Join."""

    run: str
    learner_epoch: int  # identifies this process of the learner; rollouts for another epoch are fenced
    seed: int  # for the environments and samples of this incarnation of the actor
    spec: ActorSpec
    software: str = ""  # release of the learner, such as `daedalus-rl 1.2.3`
    epsilon: float = 0.0  # probability with which this actor takes a random action in the end; 0: it does not explore
    # For an evaluator: episodes to play at once with each policy, with this seed; 0: as the specification says.
    play_episodes: int = 0
    play_seed: int = 0
    order: ComponentOrder | None = None  # of the components in the learner's network; None until the spaces are known

    def __post_init__(self) -> None:
        if not 0.0 <= self.epsilon <= 1.0:
            raise ValueError(f"epsilon is {self.epsilon}: it must be from 0 to 1")
        if self.play_episodes < 0 or self.play_seed < 0:
            raise ValueError("play_episodes and play_seed must be 0 or more")

    def entropy(self, actor: str) -> int:
        """Return 128 bits of the seed and the actor's name: seeds of 32 bits may be equal for two actors."""
        return int.from_bytes(hashlib.sha256(f"{self.seed}/{actor}".encode()).digest()[:16])


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """Negative answer to any query, with a code."""

    code: Literal[
        "mismatch", "malformed", "not_ready", "unknown", "finished", "drained", "full", "name_taken", "failed"
    ]
    reason: str
    software: str = ""  # release of the learner, where it refuses another one


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """The policy's forward pass as an ONNX model without weights, in answer to a `program` query."""

    hash: str  # see program_hash
    model: np.ndarray  # [bytes] uint8

    @classmethod
    def of(cls, model: bytes) -> "Program":
        """Return the message with a model."""
        return cls(hash=program_hash(model), model=np.frombuffer(model, np.uint8))


def program_hash(model: bytes) -> str:
    """Return the name of a program: the SHA-256 of its bytes, in hexadecimal."""
    return hashlib.sha256(model).hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement:
    """Verdict on a rollout or gradient, a report, or an order. Learner -> sender.

    accepted: it will be trained on, unless the learner ends first or its policy lag exceeds the bound.
    busy: the learner's queue is full; send it again later.
    rejected: it will never be accepted; `reason` says why.
    fenced: the rollout belongs to another epoch of the learner or another incarnation of the actor; join again.
    quarantined: no rollout of this incarnation is accepted any more, since several were invalid; `reason` says why.
    finished: the run is over.
    drained: an operator asked this actor to leave; the rollout was judged like any other.
    """

    verdict: Literal["accepted", "busy", "rejected", "fenced", "quarantined", "finished", "drained"]
    reason: str = ""
    policy_version: int = 0  # of the newest published snapshot


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """Immutable weights of one policy version. Learner -> actors, on `snapshots`.

    `program` is the hash of the program; `weights` has all of its inputs that are weights.
    """

    learner_epoch: int
    policy_version: int
    program: str
    weights: dict[str, np.ndarray]
    # Of a run with lessons: what parameters its actors draw, from the next episodes on.
    lessons: LessonPlan | None = field(default=None, metadata={"sparse": True})


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotRequest:
    """Request of an actor for the newest snapshot. Actor -> learner, on `snapshots`.

    If `compact` is false, the answer is the newest Snapshot, or a Refusal `not_ready` if the actor holds it.
    If `compact` is true, the answer is one part of a CompactSnapshot. The request for part 0 makes the
    learner encode its newest snapshot as differences to `held_version`; the requests for the other parts give the
    policy version of that snapshot, and the same `held_version`.
    """

    actor: str
    held_version: int | None  # the version that the actor holds; None: no version
    policy_version: int | None = None  # of the snapshot; None: the newest
    part: int = 0
    compact: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class LeagueRequest:
    """Request of an actor for whom to play, or for the policy of an opponent. Actor -> learner, on `snapshots`.

    Without a `player` the answer is a LeaguePlan, or a Refusal `not_ready` if the actor holds the newest. With one it
    is the Snapshot of that player, whose program may be another than the run's, or a Refusal `unknown` if it is not
    kept any more.
    """

    actor: str
    player: str = ""  # a kept version, or another run that is an opponent
    held_revision: int | None = None  # of the plan that the actor holds


@dataclass(frozen=True, slots=True, kw_only=True)
class LeaguePlan:
    """Whom an actor of a game lets play. Learner -> actor, in answer to a LeagueRequest."""

    learner_epoch: int
    plan: Plan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SnapshotPart:
    """Part of an encoded CompactSnapshot, in answer to SnapshotRequest; small, so that it does not delay other traffic.

    The concatenated parts 0 to parts - 1 are the encoded message.
    """

    learner_epoch: int
    policy_version: int
    part: int
    parts: int
    data: np.ndarray  # [bytes] uint8

    def __post_init__(self) -> None:
        if not 0 <= self.part < self.parts:
            raise ValueError(f"part is {self.part}, it must be from 0 to {self.parts - 1}")
        if self.data.ndim != 1 or self.data.dtype != np.uint8:
            raise ValueError(f"data must be uint8 [bytes], not {self.data.dtype} {self.data.shape}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CompactSnapshot:
    """Snapshot in bfloat16, whole or as differences to an earlier version (protocol/compact.py).

    Learner -> actors that request it, in SnapshotParts.
    """

    learner_epoch: int
    policy_version: int
    program: str
    base_version: int | None  # the version that the differences refer to; None: no differences
    weights: dict[str, np.ndarray]  # uint8 [2, *shape]
    lessons: LessonPlan | None = field(default=None, metadata={"sparse": True})  # as in Snapshot


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationRequest:
    """Request for a policy to evaluate. Evaluator -> learner, on `evaluations/{evaluator}`.

    The answer is a Refusal or the newest Snapshot; the learner keeps a checkpoint of that snapshot until its report.
    """

    evaluator: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluationReport:
    """Returns of an evaluated policy. Evaluator -> learner, on `evaluations/{evaluator}`."""

    evaluator: str
    learner_epoch: int
    policy_version: int
    returns: np.ndarray  # [K] float64, or float32: unscaled undiscounted returns
    lengths: np.ndarray  # [K] int32, in env_steps
    note: str = ""  # for a person, such as that episodes were cut

    def __post_init__(self) -> None:
        if self.returns.ndim != 1 or not len(self.returns) or self.returns.shape != self.lengths.shape:
            raise ValueError("returns and lengths must both be [K], with K at least 1")
        if self.returns.dtype not in EPISODE_DTYPES or self.lengths.dtype != np.int32:
            raise ValueError("returns must be float64 or float32, and lengths int32")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunEnded:
    """The learner ends. Learner -> actors and evaluators, on `end`.

    finished: the run is over, and actors leave.
    stopped: the run is not over, and actors wait for the learner to return.
    """

    learner_epoch: int
    outcome: Literal["finished", "stopped"]
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReport:
    """State of the run and its first actors, in answer to a `status` query without payload."""

    status: RunStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorsRequest:
    """Request of an operator for the next actors of the status. Operator -> learner, on `status`."""

    after: str  # the last name that the operator has


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorsReport:
    """The actors with the next names, in answer to an ActorsRequest; none after the last."""

    page: ActorsPage


@dataclass(frozen=True, slots=True, kw_only=True)
class EventsRequest:
    """Request of an operator for the newest events of the run. Operator -> learner, on `status`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventsReport:
    """The newest events, in answer to an EventsRequest."""

    page: EventsPage


Message = (
    Join
    | Welcome
    | Refusal
    | Program
    | Rollout
    | Gradient
    | Acknowledgement
    | Snapshot
    | SnapshotRequest
    | LeagueRequest
    | LeaguePlan
    | SnapshotPart
    | CompactSnapshot
    | EvaluationRequest
    | EvaluationReport
    | RunEnded
    | StatusReport
    | ActorsRequest
    | ActorsReport
    | EventsRequest
    | EventsReport
    | ClientReport
    | MetricsRequest
    | MetricsReport
    | OrderRequest
)
