"""The messages of the protocol, as frozen dataclasses; larger ones have files of their own.

Shapes are checked at construction, so an inconsistent message can neither be sent nor decoded. codec.py encodes
messages, keys.py names the keys that they use, and the learner's intake decides which it accepts.
"""

import hashlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

from daedalus.protocol.client_report import ClientReport
from daedalus.protocol.metrics import MetricsReport, MetricsRequest
from daedalus.protocol.orders import OrderRequest
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.status import ActorsPage, EventsPage, RunStatus
from daedalus.protocol.uploads import EPISODE_DTYPES, Gradient, Rollout


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
    epsilon: float = 0.0  # probability with which this actor takes a random action in the end; 0: it does not explore

    def __post_init__(self) -> None:
        if not 0.0 <= self.epsilon <= 1.0:
            raise ValueError(f"epsilon is {self.epsilon}: it must be from 0 to 1")

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """The policy's forward pass as an ONNX model without weights, in answer to a `program` query."""

    hash: str  # SHA-256 of `model`, hexadecimal
    model: np.ndarray  # [bytes] uint8


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement:
    """Verdict on a rollout or gradient, a report, an order, or a request on `drain/{actor}`. Learner -> sender.

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
