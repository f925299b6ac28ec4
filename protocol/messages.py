"""The vocabulary of the wire: every message that crosses it, as frozen data.

Shapes are checked at construction, so an inconsistent message can neither be sent nor leave the
decoder. This file does not know how messages become bytes (codec.py), on which key they travel
(keys.py), nor whether they are welcome (the learner's intake).

Time first: row t holds observation t, the action chosen from it and the reward that action earned.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.status import RunStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class Join:
    """An actor asks to take part. Actor -> learner, on `join`.

    Sent twice: without spaces it asks what to play; with the spaces that it then found in the
    environment it asks to be counted in.
    """

    actor: str  # a name that survives restarts
    incarnation: int  # this life of the process
    spaces: Spaces | None = None
    environments: int = 0  # how many it plays at once


@dataclass(frozen=True, slots=True, kw_only=True)
class Welcome:
    """What an actor needs to play: learner -> actor, in answer to Join."""

    run: str
    learner_epoch: int  # this life of the learner; rollouts of another are fenced
    seed: int  # for this actor's environments and samples, and this life of it only
    spec: RunSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """A typed no, in answer to any query."""

    code: Literal["mismatch", "malformed", "not_ready", "unknown", "finished", "full", "name_taken"]
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """The policy's forward pass as an ONNX model without weights, in answer to a `program` query."""

    hash: str  # SHA-256 of `model`, hexadecimal
    model: np.ndarray  # [bytes] uint8


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutIdentity:
    """Makes a rollout unique: the learner trains on each at most once."""

    actor: str
    incarnation: int
    sequence: int  # counts up from 0 within an incarnation and learner epoch
    learner_epoch: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rollout:
    """T consecutive rows of E environments under one snapshot. Actor -> learner, on `rollouts/{actor}`.

    Each frame travels once: where the policy sees k frames stacked, the observation of row t is made of frames t to
    t+k-1, the first frame of an episode in place of those before it (protocol/frames.py); k is 1 elsewhere.
    Environments reset by gymnasium's NEXT_STEP rule: the row after an episode's end only resets, its
    action was ignored and it is not `valid`; its observation is the true last one of the episode.
    """

    identity: RolloutIdentity
    policy_version: int  # of the behaviour policy
    frames: np.ndarray  # [k-1 + T+1, E, *frame_shape]; the last row bootstraps
    initial_state: np.ndarray  # [E, S] float32, the policy's memory at row 0; S is 0 where it has none
    actions: np.ndarray  # [T, E] integers
    behaviour_log_probs: np.ndarray  # [T, E] float32, log mu(a_t | s_t)
    rewards: np.ndarray  # [T, E] float32, as learning shall see them (scaled)
    terminated: np.ndarray  # [T, E] bool, the environment ended the episode
    truncated: np.ndarray  # [T, E] bool, a limit did
    valid: np.ndarray  # [T, E] bool, False where the environment only reset
    episode_returns: np.ndarray  # [K] float32, true undiscounted returns of the episodes that ended here
    episode_lengths: np.ndarray  # [K] int32, their env_steps

    def __post_init__(self) -> None:
        if self.actions.ndim != 2:
            raise ValueError(f"actions must be [T, E], not {self.actions.shape}")
        rows, environments = self.actions.shape
        if rows == 0 or environments == 0:
            raise ValueError("a rollout needs at least one row and one environment")
        if self.frames.ndim < 3 or len(self.frames) <= rows or self.frames.shape[1] != environments:
            raise ValueError(f"frames must be [{rows + 1} or more, {environments}, ...], not {self.frames.shape}")
        if self.initial_state.ndim != 2 or len(self.initial_state) != environments:
            raise ValueError(f"initial_state must be [{environments}, S], not {self.initial_state.shape}")
        for name in ("behaviour_log_probs", "rewards", "terminated", "truncated", "valid"):
            shape = getattr(self, name).shape
            if shape != (rows, environments):
                raise ValueError(f"{name} must be [{rows}, {environments}] like actions, not {shape}")
        for name in ("terminated", "truncated", "valid"):
            if getattr(self, name).dtype != np.bool_:
                raise ValueError(f"{name} must be bool, not {getattr(self, name).dtype}")
        for name in ("initial_state", "behaviour_log_probs", "rewards", "episode_returns"):
            if getattr(self, name).dtype != np.float32:
                raise ValueError(f"{name} must be float32, not {getattr(self, name).dtype}")
        if self.actions.dtype.kind not in "iu" or self.episode_lengths.dtype.kind not in "iu":
            raise ValueError("actions and episode_lengths must be integers")
        if self.episode_returns.ndim != 1 or self.episode_returns.shape != self.episode_lengths.shape:
            raise ValueError("episode_returns and episode_lengths must be [K] alike")
        if len(self.episode_returns) > rows * environments:
            raise ValueError("more episodes ended than the rollout has rows")

    @property
    def rows(self) -> int:
        """T."""
        return self.actions.shape[0]

    @property
    def environments(self) -> int:
        """E."""
        return self.actions.shape[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement:
    """What became of a rollout or of an evaluation's report: learner -> who sent it.

    accepted: it will be trained on, unless the learner ends first or its policy lag outgrows the bound.
    busy: the learner has no room now; send it again. rejected: never; `reason` says why.
    fenced: the rollout belongs to another life of the learner; join again. finished: the run is over.
    quarantined: nothing more is taken from this life of the actor, whose rollouts were unfit; `reason` says how.
    """

    verdict: Literal["accepted", "busy", "rejected", "fenced", "quarantined", "finished"]
    reason: str = ""
    policy_version: int = 0  # the newest that was published


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """Weights at one policy version, immutable. Learner -> actors, on `snapshots`.

    `program` names the program they bind to; every input of it but the observation is among them.
    """

    learner_epoch: int
    policy_version: int
    program: str
    weights: dict[str, np.ndarray]


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotRequest:
    """An actor on a slow link asks for a part of a CompactSnapshot: actor -> learner, on `snapshots`.

    Asking for part 0 has the newest one made, for the version that the actor holds; the others follow by its version.
    """

    actor: str
    held_version: int | None  # what differences are to be to; None: it holds none
    policy_version: int | None = None  # of the one whose part is asked for; None: the newest
    part: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SnapshotPart:
    """A piece of an encoded CompactSnapshot, in answer to SnapshotRequest: small enough to hold up nobody's traffic.

    The pieces 0 to parts - 1, one after the other, are the message.
    """

    learner_epoch: int
    policy_version: int
    part: int
    parts: int
    data: np.ndarray  # [bytes] uint8

    def __post_init__(self) -> None:
        if not 0 <= self.part < self.parts:
            raise ValueError(f"part {self.part} of {self.parts}")
        if self.data.ndim != 1 or self.data.dtype != np.uint8:
            raise ValueError(f"data must be uint8 [bytes], not {self.data.dtype} {self.data.shape}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CompactSnapshot:
    """A Snapshot in bfloat16, whole or as differences to an earlier version (protocol/compact.py).

    Learner -> actors on slow links, in SnapshotParts.
    """

    learner_epoch: int
    policy_version: int
    program: str
    base_version: int | None  # what the differences are to; None: it is whole
    weights: dict[str, np.ndarray]  # uint8 [2, *shape]


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationRequest:
    """An evaluator asks for a policy to play: evaluator -> learner, on `evaluations/{evaluator}`.

    The answer is the newest Snapshot, of which the learner keeps a checkpoint until it is reported on, or a Refusal.
    """

    evaluator: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluationReport:
    """How the policy of an EvaluationRequest played: evaluator -> learner, on `evaluations/{evaluator}`."""

    evaluator: str
    learner_epoch: int
    policy_version: int
    returns: np.ndarray  # [K] float32, true undiscounted returns
    lengths: np.ndarray  # [K] int32, in env_steps

    def __post_init__(self) -> None:
        if self.returns.ndim != 1 or not len(self.returns) or self.returns.shape != self.lengths.shape:
            raise ValueError("returns and lengths must be [K] alike, with K at least 1")
        if self.returns.dtype != np.float32 or self.lengths.dtype != np.int32:
            raise ValueError("returns must be float32 and lengths int32")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunEnded:
    """The run is over: learner -> actors, on `snapshots`. Actors leave."""

    learner_epoch: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReport:
    """The fleet as the learner sees it, in answer to a `status` query."""

    status: RunStatus


Message = (
    Join
    | Welcome
    | Refusal
    | Program
    | Rollout
    | Acknowledgement
    | Snapshot
    | SnapshotRequest
    | SnapshotPart
    | CompactSnapshot
    | EvaluationRequest
    | EvaluationReport
    | RunEnded
    | StatusReport
)
