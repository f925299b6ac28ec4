"""All messages of the protocol, as frozen dataclasses.

Shapes are checked at construction, so an inconsistent message can neither be sent nor decoded. codec.py encodes
messages, keys.py names the keys that they use, and the learner's intake decides which it accepts.

Time first: row t holds observation t, the action chosen from it and the reward that action earned.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from daedalus.protocol.client_report import ClientReport
from daedalus.protocol.keys import check_name
from daedalus.protocol.metrics import MetricsReport, MetricsRequest
from daedalus.protocol.orders import OrderRequest
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.status import ActorsPage, EventsPage, RunStatus

MAX_INFO_NAMES, MAX_INFO_VALUES = 16, 256  # of Rollout.episode_info
LARGEST_GRADIENT_NORM = 1e12  # no healthy actor comes near it, and the mean of many gradients stays finite
# Names in Gradient.metrics: the terms of the loss (algorithms/gradients.py), and the diagnostics that an algorithm
# gives of a rollout (algorithms/diagnostics.py).
LOSS_TERMS = ("policy_loss", "value_loss", "entropy", "clipped_fraction")
DIAGNOSTICS = (
    "explained_variance",
    "value_mean",
    "advantage_std",
    "behaviour_kl",
    "rho_mean",
    "rho_effective_share",
    "value_error_p05",
    "value_error_p50",
    "value_error_p95",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Where an actor runs, as the actor states it: for an operator who reads the status. Each text may be empty."""

    host: str = ""  # name of the host
    software: str = ""  # name and version, such as `daedalus-rl 1.2.3`
    address: str = ""  # of the actor's end of the connection, such as `tcp/10.0.0.7:43092`


UNKNOWN = Origin()


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
    spec: RunSpec
    epsilon: float = 0.0  # probability with which this actor takes a random action in the end; 0: it does not explore

    def __post_init__(self) -> None:
        if not 0.0 <= self.epsilon <= 1.0:
            raise ValueError(f"epsilon is {self.epsilon}: it must be from 0 to 1")


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
class RolloutIdentity:
    """Unique identity of a rollout: the learner trains on each rollout at most once."""

    actor: str
    incarnation: int
    sequence: int  # counts up from 0 within an incarnation and learner epoch
    learner_epoch: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rollout:
    """T consecutive rows of E environments under one snapshot. Actor -> learner, on `rollouts/{actor}`.

    Each frame is sent once. With a frame stack of k, the observation of row t consists of the frames t to t+k-1, where
    the first frame of an episode replaces the frames before it (protocol/frames.py); without a frame stack k is 1.
    Environments reset by gymnasium's NEXT_STEP rule: the row after the end of an episode only resets the environment.
    Its action was ignored and it is not `valid`; its observation is the final observation of the episode.

    Where somebody else than the policy chose the action that was played, such as a person or a safety filter, a row is
    `overridden`: it holds the action that the policy would have taken. It is not learned from, and the rows before it
    are bootstrapped with the value of its observation, but the episode and the memory of the policy go on.

    Observations, actions and masks are maps of components, as in Spaces (protocol/spaces.py).
    """

    identity: RolloutIdentity
    policy_version: int  # of the behaviour policy
    frames: dict[str, np.ndarray]  # each [k-1 + T+1, E, *frame_shape], discrete ones [T+1, E, D]; the last bootstraps
    initial_state: np.ndarray  # [E, S] float32, the policy's memory at row 0; S is 0 without a memory
    actions: dict[str, np.ndarray]  # each [T, E, D]: integers, or float32 as ContinuousSpace describes
    masks: dict[str, np.ndarray]  # of the masked actions [T, E, choices] bool, True for a legal choice
    behaviour_log_probs: np.ndarray  # [T, E] float32, log mu(a_t | s_t), summed over the components of the action
    rewards: np.ndarray  # [T, E] float32, scaled and clipped for learning
    terminated: np.ndarray  # [T, E] bool, the environment ended the episode
    truncated: np.ndarray  # [T, E] bool, a limit ended the episode
    valid: np.ndarray  # [T, E] bool, False where the environment only reset
    episode_returns: np.ndarray  # [K] float32, unscaled undiscounted returns of the episodes that ended in this rollout
    episode_lengths: np.ndarray  # [K] int32, their env_steps
    # By name [n] float32, n from 1 to K: scalars of the environment's `info` at the ends of these episodes.
    episode_info: dict[str, np.ndarray] = field(default_factory=dict)
    overridden: np.ndarray | None = None  # [T, E] bool, somebody else chose the action; None: in no row

    def __post_init__(self) -> None:
        if self.rewards.ndim != 2:
            raise ValueError(f"rewards must be [T, E], not {self.rewards.shape}")
        rows, environments = self.rewards.shape
        if rows == 0 or environments == 0:
            raise ValueError("a rollout must have at least one row and one environment")
        if not self.frames or not self.actions:
            raise ValueError("a rollout must have observations and actions")
        for name, frames in self.frames.items():
            if frames.ndim < 3 or len(frames) <= rows or frames.shape[1] != environments:
                raise ValueError(f"frames/{name} must be [{rows + 1} or more, {environments}, ...], not {frames.shape}")
        if self.initial_state.ndim != 2 or len(self.initial_state) != environments:
            raise ValueError(f"initial_state must be [{environments}, S], not {self.initial_state.shape}")
        for kind, components in (("actions", self.actions), ("masks", self.masks)):
            for name, values in components.items():
                if values.ndim != 3 or values.shape[:2] != (rows, environments):
                    raise ValueError(f"{kind}/{name} must be [{rows}, {environments}, D], not {values.shape}")
        for name, array in {"behaviour_log_probs": self.behaviour_log_probs, **self._flags}.items():
            if array.shape != (rows, environments):
                raise ValueError(f"{name} must be [{rows}, {environments}] like rewards, not {array.shape}")
        self._check_dtypes()
        _check_episodes(self)
        if len(self.episode_returns) > rows * environments:
            raise ValueError("more episodes ended than the rollout has rows")

    def _check_dtypes(self) -> None:
        masks = {f"masks/{name}": mask for name, mask in self.masks.items()}
        for name, array in (self._flags | masks).items():
            if array.dtype != np.bool_:
                raise ValueError(f"{name} must be bool, not {array.dtype}")
        for name in ("initial_state", "behaviour_log_probs", "rewards"):
            if getattr(self, name).dtype != np.float32:
                raise ValueError(f"{name} must be float32, not {getattr(self, name).dtype}")
        for name, actions in self.actions.items():
            if actions.dtype != np.float32 and actions.dtype.kind not in "iu":
                raise ValueError(f"actions/{name} must be float32 or integers, not {actions.dtype}")

    @property
    def _flags(self) -> dict[str, np.ndarray]:
        flags = {"terminated": self.terminated, "truncated": self.truncated, "valid": self.valid}
        return flags if self.overridden is None else flags | {"overridden": self.overridden}

    @property
    def rows(self) -> int:
        """T, the number of rows."""
        return self.rewards.shape[0]

    @property
    def environments(self) -> int:
        """E, the number of environments."""
        return self.rewards.shape[1]

    @property
    def learned(self) -> np.ndarray:
        """Rows to learn from [T, E] bool: valid, and not overridden."""
        return self.valid if self.overridden is None else self.valid & ~self.overridden

    @property
    def env_steps(self) -> int:
        """Number of rows to learn from, over all environments."""
        return int(np.count_nonzero(self.learned))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gradient:
    """Gradient of one rollout at the weights that played it. Actor -> learner, on `rollouts/{actor}`.

    Actors send it in place of the rollout if `collection.upload` is `gradients`. With it come the results that the
    learner would compute from the rows.
    """

    identity: RolloutIdentity  # of the rollout
    policy_version: int  # of the weights
    # By parameter that has a gradient: float32 [*shape], or the planes of its bfloat16 (protocol/compact.py), uint8
    # [2, *shape]. The mean over the valid rows; not clipped.
    gradient: dict[str, np.ndarray]
    env_steps: int  # valid rows of the rollout
    metrics: dict[str, np.ndarray]  # each of LOSS_TERMS, and those of DIAGNOSTICS that are known: float32 scalars []
    # Mean and sum of squared deviations over the valid rows, float64 [2, *shape]: `observations/NAME` of each component
    # that is normalised, and `returns` of the discounted returns if rewards are normalised.
    moments: dict[str, np.ndarray]
    action_counts: dict[str, np.ndarray]  # of each discrete component [choices] int64
    episode_returns: np.ndarray  # as in Rollout, like the next two
    episode_lengths: np.ndarray
    episode_info: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.gradient:
            raise ValueError("a gradient must have parameters")
        for name, values in self.gradient.items():
            planes = values.dtype == np.uint8 and values.ndim > 0 and len(values) == 2
            if values.dtype != np.float32 and not planes:
                raise ValueError(f"gradient/{name} must be float32 or uint8 [2, ...], not {values.dtype}")
        for name, values in self.metrics.items():
            if values.shape or values.dtype != np.float32:
                raise ValueError(f"metrics/{name} must be float32 [], not {values.dtype} {values.shape}")
        for name, values in self.moments.items():
            if values.dtype != np.float64 or values.ndim < 1 or len(values) != 2:
                raise ValueError(f"moments/{name} must be float64 [2, ...], not {values.dtype} {values.shape}")
        for name, values in self.action_counts.items():
            if values.dtype != np.int64 or values.ndim != 1:
                raise ValueError(f"action_counts/{name} must be int64 [choices], not {values.dtype} {values.shape}")
        _check_episodes(self)

    @property
    def norm(self) -> float:
        """Norm of a float32 gradient; nan or inf if a value is not finite."""
        flat = (values.ravel().astype(np.float64) for values in self.gradient.values())
        return math.sqrt(sum(float(values @ values) for values in flat))


Upload = Rollout | Gradient


def _check_episodes(upload: Upload) -> None:
    """Raise ValueError if the results of episodes are inconsistent."""
    returns, lengths = upload.episode_returns, upload.episode_lengths
    if returns.ndim != 1 or returns.shape != lengths.shape:
        raise ValueError("episode_returns and episode_lengths must both be [K]")
    if returns.dtype != np.float32:
        raise ValueError(f"episode_returns must be float32, not {returns.dtype}")
    if lengths.dtype.kind not in "iu":
        raise ValueError("episode_lengths must be integers")
    if len(upload.episode_info) > MAX_INFO_NAMES:
        raise ValueError(f"episode_info has {len(upload.episode_info)} names, at most {MAX_INFO_NAMES} are allowed")
    most = min(len(returns), MAX_INFO_VALUES)
    for name, values in upload.episode_info.items():
        check_name(name, "the name in episode_info")
        if values.ndim != 1 or values.dtype != np.float32 or not 1 <= len(values) <= most:
            raise ValueError(
                f"episode_info {name!r} must be float32 [n], with n from 1 to {most}, not {values.dtype} {values.shape}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement:
    """Verdict on a rollout, an evaluation report or a request on `drain/{actor}`. Learner -> sender.

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
    If `compact` is true, the answer is one part of a CompactSnapshot, for a slow link. The request for part 0 makes the
    learner encode its newest snapshot as differences to `held_version`; the requests for the other parts give the
    policy version of that snapshot.
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

    Learner -> actors on slow links, in SnapshotParts.
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
    returns: np.ndarray  # [K] float32, unscaled undiscounted returns
    lengths: np.ndarray  # [K] int32, in env_steps

    def __post_init__(self) -> None:
        if self.returns.ndim != 1 or not len(self.returns) or self.returns.shape != self.lengths.shape:
            raise ValueError("returns and lengths must both be [K], with K at least 1")
        if self.returns.dtype != np.float32 or self.lengths.dtype != np.int32:
            raise ValueError("returns must be float32 and lengths int32")


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
