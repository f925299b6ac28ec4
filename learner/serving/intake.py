"""Bytes -> verdict. Decides what is trained on; somebody else acts on it. No threads, no I/O.

Every rollout is decoded, held against the run's specification, and taken at most once. What is wrong with a bad
one is the sender's fault: it is named, counted and dropped, and nothing else changes.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from daedalus.learner.serving.fleet import Actor, Fleet
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Rollout
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_ROW_BYTES = 1 + 2 + 4 * 4 + 8  # an environment's share of a row without its observation, rounded up
_SLACK_BYTES = 64 << 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected:
    """A rollout never to train on; `cause` is what it is counted under, `reason` what its sender is told."""

    verdict: Literal["rejected", "fenced", "quarantined"]
    cause: str
    reason: str


class Intake:
    """Judges rollouts against a run's specification and the fleet's state."""

    def __init__(self, spec: RunSpec, learner_epoch: int, fleet: Fleet) -> None:
        self._spec = spec
        self._epoch = learner_epoch
        self._fleet = fleet
        # On-policy learning takes nothing but the newest version.
        self._max_lag = 0 if spec.algorithm.synchronous else spec.training.policy_lag_bound
        self.state_size = 0  # of the policy's memory; known before any actor has the program

    def read(self, sender: str, data: bytes) -> Rollout | Rejected:
        """Decodes what `sender` put on its key, and holds its content against the specification.

        Takes the time it takes, changes nothing, and needs no lock: `judge` looks again at what may have changed.
        """
        spaces, actor = self._fleet.spaces, self._fleet.actors.get(sender)
        if spaces is None or actor is None or not actor.environments:
            return Rejected(verdict="fenced", cause="unknown_actor", reason=f"{sender!r} has not joined")
        if actor.quarantined:
            return Rejected(verdict="quarantined", cause="quarantined", reason=actor.quarantined)
        try:
            rollout = decode(data, self._limits(spaces, actor))
        except ProtocolError as error:
            return Rejected(verdict="rejected", cause="malformed", reason=str(error))
        if not isinstance(rollout, Rollout):
            return Rejected(verdict="rejected", cause="malformed", reason="not a rollout")
        stranger = self._check_identity(sender, rollout)
        if stranger is not None:
            return stranger
        fault = self._fault(rollout, spaces, actor)
        return Rejected(verdict="rejected", cause="unfit", reason=fault) if fault else rollout

    def judge(self, sender: str, content: Rollout | Rejected, policy_version: int, now: float) -> Rollout | Rejected:
        """Decides over what `read` returned while the newest version is `policy_version`, and counts it."""
        verdict = content if isinstance(content, Rejected) else self._judge(sender, content, policy_version)
        actor = self._fleet.actors.get(sender)
        if actor is not None:
            actor.last_seen = now
            if isinstance(verdict, Rejected):
                actor.rejected[verdict.cause] += 1
            else:
                actor.accepted += 1
                actor.unfit = 0
                actor.policy_lag = policy_version - verdict.policy_version
            if isinstance(verdict, Rejected) and verdict.cause == "unfit":
                actor.note_unfit(verdict.reason)
                if actor.quarantined:
                    verdict = Rejected(verdict="quarantined", cause="unfit", reason=actor.quarantined)
        return verdict

    def _judge(self, sender: str, rollout: Rollout, policy_version: int) -> Rollout | Rejected:
        stranger = self._check_identity(sender, rollout)
        if stranger is not None:
            return stranger
        identity, actor = rollout.identity, self._fleet.actors[sender]
        if identity.sequence in actor.sequences:
            return Rejected(verdict="rejected", cause="duplicate", reason="was taken before")
        lag = policy_version - rollout.policy_version
        if lag < 0:
            return Rejected(verdict="rejected", cause="unfit", reason="its policy version is yet to come")
        actor.sequences.add(identity.sequence)
        if lag > self._max_lag:
            return Rejected(
                verdict="rejected",
                cause="stale",
                reason=f"policy lag {lag}, at most {self._max_lag} is allowed",
            )
        return rollout

    def _check_identity(self, sender: str, rollout: Rollout) -> Rejected | None:
        """Why a rollout is from or for another life than those that run now, or None."""
        identity = rollout.identity
        if identity.learner_epoch != self._epoch:
            return Rejected(verdict="fenced", cause="epoch", reason="meant for another life of the learner")
        if identity.actor != sender or self._fleet.expected(identity) is None:
            return Rejected(verdict="fenced", cause="unknown_actor", reason="another life of this actor has joined")
        return None

    def _limits(self, spaces: Spaces, actor: Actor) -> Limits:
        """What the specification and the actor's own word allow a rollout to unpack to."""
        frame = math.prod(spaces.observation.shape) * np.dtype(spaces.observation.dtype).itemsize
        rows = self._spec.collection.rollout_length + spaces.observation.frames
        row_bytes = actor.environments * (frame + _ROW_BYTES)
        state_bytes = 4 * actor.environments * self.state_size
        return Limits(max_bytes=rows * row_bytes + state_bytes + _SLACK_BYTES, max_arrays=16)

    def _fault(self, rollout: Rollout, spaces: Spaces, actor: Actor) -> str:
        """What about its content is against the specification, or nothing."""
        space, rows = spaces.observation, self._spec.collection.rollout_length
        if (rollout.rows, rollout.environments) != (rows, actor.environments):
            return (
                f"it has {rollout.rows} rows of {rollout.environments} environments, "
                f"this run has {rows} of this actor's {actor.environments}"
            )
        expected = (rows + space.frames, actor.environments, *space.shape)
        if rollout.frames.shape != expected or rollout.frames.dtype != space.dtype:
            return (
                f"frames are {rollout.frames.dtype} {rollout.frames.shape}, "
                f"this run has {space.dtype} {expected} ({space})"
            )
        if rollout.initial_state.shape[1] != self.state_size:
            return f"its policy remembers {rollout.initial_state.shape[1]} numbers, this run's {self.state_size}"
        if rollout.actions.min() < 0 or rollout.actions.max() >= spaces.action.count:
            return f"actions has a value that is not one of {spaces.action}"
        for name in ("frames", "initial_state", "behaviour_log_probs", "rewards", "episode_returns"):
            if not np.isfinite(getattr(rollout, name)).all():
                return f"{name} has a value that is not finite"
        if (rollout.behaviour_log_probs > 1e-4).any():
            return "behaviour_log_probs has a value above 0"
        environment = self._spec.environment
        if environment.reward_clip is not None:
            largest = environment.reward_clip * environment.reward_scale
            if np.abs(rollout.rewards).max() > largest * (1 + 1e-5):
                return f"rewards has a value beyond the {largest:g} that they are clipped to"
        if (rollout.episode_lengths < 1).any():
            return "episode_lengths has a value below 1"
        return ""


def acknowledgement(verdict: Rollout | Rejected, policy_version: int) -> Acknowledgement:
    """What to tell the sender."""
    if isinstance(verdict, Rollout):
        return Acknowledgement(verdict="accepted", policy_version=policy_version)
    return Acknowledgement(verdict=verdict.verdict, reason=verdict.reason[:500], policy_version=policy_version)
