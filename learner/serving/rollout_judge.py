"""Bytes -> verdict: decides which rollouts are trained on. The caller acts on the verdict. No threads, no I/O.

Every rollout is decoded, checked against the run's specification, and accepted at most once. A rejected rollout is the
sender's fault: it is counted and dropped, and the sender receives the reason.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from daedalus.learner.league.run_league import League
from daedalus.learner.run.lesson_progress import lessons_violation
from daedalus.learner.serving.actor_state import Actor
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.upload_checks import (
    Shapes,
    first_component_violation,
    gradient_limits,
    gradient_violation,
    number_violation,
    restored,
)
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement
from daedalus.protocol.spaces import LARGEST_REWARD, DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import bounded_text
from daedalus.protocol.uploads import MAX_INFO_NAMES, Gradient, Rollout, Upload

# Per environment and row, besides observations, actions and masks, rounded up; integers may be sent in 8 bytes each.
_ROW_BYTES, _INTEGER_BYTES = 24, 8
_SLACK_BYTES = 64 << 10
_MOST_GRADIENT_ROWS = 250_000.0  # a second, of which one actor's thread computes gradients: none comes near it
_CLIENT_ROWS = 10_000.0  # a second, that an environment of a client plays: none comes near it
_BEGIN_SECONDS = 10.0  # that an actor may have played before it joined
_LOST = 4  # rollouts that were sent, at most, for each that has arrived
_MAX_REASON = 500  # bytes, in the answer to a rollout
_OTHER_ARRAYS = 17  # besides observations, actions, masks and scalars of info
# Largest decoded rollout, whichever is larger: bytes, or rollouts with the run's own number of environments. An actor
# chooses its number, and zeros compress to nothing: the learner's memory must not depend on the actor.
_MAX_ROLLOUT_BYTES, _MAX_ROLLOUTS = 64 << 20, 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected:
    """Verdict on a rollout that is not trained on.

    `cause` is the category that the rejection is counted under; `reason` is the text for the sender.
    """

    verdict: Literal["rejected", "fenced", "quarantined"]
    cause: str
    reason: str


def _unknown(sender: str) -> Rejected:
    return Rejected(verdict="fenced", cause="unknown_actor", reason=f"actor {sender!r} has not joined")


class RolloutJudge:
    """Judge of rollouts by the run's specification and the state of the fleet."""

    def __init__(self, spec: RunSpec, learner_epoch: int, fleet: Fleet, league: League | None = None) -> None:
        """Construct the judge; `league` is that of a game, whose matches rollouts report."""
        self._spec, self._league = spec, league
        self._epoch = learner_epoch
        self._fleet = fleet
        self._envs_per_actor = spec.collection.envs_per_actor
        # Set before any actor has the program:
        self.state_size = 0  # size of the recurrent state
        self.gradient_shapes: Shapes = {}  # of the parameters that have gradients

    def refuse_size(self, sender: str, size: int) -> Rejected | None:
        """Return the verdict on a message of `size` bytes that no rollout of `sender` has, or None. Reads no message.

        Call this method without the lock.
        """
        spaces, actor = self._fleet.spaces, self._fleet.actors.get(sender)
        if size <= _SLACK_BYTES:
            return None
        if spaces is None or actor is None:
            return _unknown(sender)
        plain, queue = self._limits(spaces, actor.environments).message_bytes, self._spec.service.queue_bytes
        if size > plain:
            reason = f"the message has {size:,} bytes, and a rollout of this actor at most {plain:,}"
            return Rejected(verdict="rejected", cause="malformed", reason=reason)
        if size > queue:
            reason = (
                f"the rollout has {size:,} bytes, and service.queue_megabytes allows {queue:,}: raise that setting, or "
                "use fewer environments per actor (collection.envs_per_actor, or --envs of daedalus actor)"
            )
            return Rejected(verdict="rejected", cause="unfit", reason=reason)
        return None

    @property
    def expected_bytes(self) -> int:
        """Largest size in memory of an upload with the run's own number of environments; 0 before an actor joins."""
        spaces = self._fleet.spaces
        return 0 if spaces is None else self._limits(spaces, self._envs_per_actor).max_bytes

    def read(self, sender: str, data: bytes) -> Upload | Rejected:
        """Decode a message of `sender`, and check its content against the specification.

        Call this method without the lock: decoding is slow and changes no state. `decide` repeats the checks whose
        result may change in the meantime.
        """
        spaces, actor = self._fleet.spaces, self._fleet.actors.get(sender)
        if spaces is None or actor is None:
            return _unknown(sender)
        if actor.quarantined:
            return Rejected(verdict="quarantined", cause="quarantined", reason=actor.quarantined)
        limits = self._limits(spaces, actor.environments)
        most = max(_MAX_ROLLOUT_BYTES, _MAX_ROLLOUTS * self.expected_bytes)
        if limits.max_bytes > most:
            reason = (
                f"a rollout of {actor.environments} environments has {limits.max_bytes:,} bytes, at most {most:,} are "
                "allowed: use fewer environments per actor (collection.envs_per_actor, or --envs of daedalus actor)"
            )
            return Rejected(verdict="rejected", cause="unfit", reason=reason)
        try:
            upload = decode(data, limits)
        except ProtocolError as error:
            return Rejected(verdict="rejected", cause="malformed", reason=str(error))
        if not isinstance(upload, Gradient if self._spec.uploads_gradients else Rollout):
            kind = "gradient, which this run takes (collection.upload)" if self._spec.uploads_gradients else "rollout"
            return Rejected(verdict="rejected", cause="malformed", reason=f"the message is not a {kind}")
        wrong_identity = self._check_identity(sender, upload)
        if wrong_identity is not None:
            return wrong_identity
        if isinstance(upload, Gradient):
            upload = restored(upload)
        violation = self._first_violation(upload, spaces, actor)
        return Rejected(verdict="rejected", cause="unfit", reason=violation) if violation else upload

    def decide(
        self, sender: str, content: Upload | Rejected, policy_version: int, now: float, *, surplus: bool = False
    ) -> Upload | Rejected:
        """Decide on a result of `read`, count the verdict, and return it. The caller holds the lock.

        Args:
          sender: name of the actor.
          content: result of `read`.
          policy_version: newest policy version; the policy lag is relative to it.
          now: time on the monotonic clock, in seconds.
          surplus: whether the batch has no room for a rollout of this actor.
        """
        verdict = content
        if not isinstance(content, Rejected):
            verdict = self._judge(sender, content, policy_version, now)
        if surplus and not isinstance(verdict, Rejected):
            reason = "the batch already has a rollout of this actor, or is full"
            verdict = Rejected(verdict="rejected", cause="surplus", reason=reason)
        actor = self._fleet.actors.get(sender)
        if actor is not None:
            actor.heard(now)
            if isinstance(verdict, Rejected):
                actor.rejected[verdict.cause] += 1
            else:
                actor.accepted += 1
                actor.rows += verdict.agent_steps
                actor.episode_rows += int(verdict.episode_lengths.sum(dtype=np.int64))
                actor.consecutive_unfit = 0
                actor.policy_lag = policy_version - verdict.policy_version
            if isinstance(verdict, Rejected) and verdict.cause == "unfit":
                actor.count_unfit(verdict.reason)
                if actor.quarantined:
                    self._fleet.changed()
                    verdict = Rejected(verdict="quarantined", cause="unfit", reason=actor.quarantined)
        return verdict

    def is_too_fast(self, upload: Upload | Rejected, now: float) -> bool:
        """Return whether an actor states more env_steps than it can have computed gradients of since it joined.

        A few bytes can state very many. With rollouts the learner itself has to compute, and nobody outruns it.
        """
        if not isinstance(upload, Gradient):
            return False
        actor = self._fleet.find(upload.identity)
        if actor is None:
            return False
        most = _MOST_GRADIENT_ROWS * (now - actor.joined + 1.0)
        return actor.rows + upload.env_steps > most

    def _judge(self, sender: str, rollout: Upload, policy_version: int, now: float) -> Upload | Rejected:
        wrong_identity = self._check_identity(sender, rollout)
        if wrong_identity is not None:
            return wrong_identity
        identity, actor = rollout.identity, self._fleet.actors[sender]
        if identity.sequence in actor.sequences:
            return Rejected(verdict="rejected", cause="duplicate", reason="the rollout was received before")
        lag = policy_version - rollout.policy_version
        if lag < 0:
            reason = f"policy version {rollout.policy_version} is newer than the learner's version {policy_version}"
            return Rejected(verdict="rejected", cause="unfit", reason=reason)
        violation = self._impossible_episodes(rollout, actor, now)
        if violation:
            return Rejected(verdict="rejected", cause="unfit", reason=violation)
        actor.sequences.add(identity.sequence)
        actor.uploads += 1
        actor.matches += _matches(rollout)
        # A synchronous algorithm accepts only rollouts of the newest version.
        most = 0 if self._spec.algorithm.synchronous else self._spec.policy_lag_bound_with(len(self._fleet.live))
        if lag > most:
            return Rejected(verdict="rejected", cause="stale", reason=f"policy lag {lag}, at most {most} is allowed")
        return rollout

    def _impossible_episodes(self, upload: Upload, actor: Actor, now: float) -> str:
        """Return why the actor cannot have played the episodes that it reports, or an empty string.

        They cannot be longer than the rows that it has played. Those are the ones that it has sent: environments begin
        anew when an actor joins. Some may be lost on the way, which sequence numbers show, but they are not believed
        alone. A client plays rows that it never sends, such as while it waits, or while a person steers: it has one
        environment in a rollout, unless its agents act in step, and lives in real time. The seats of a game play such
        rows, too, while others act less often.
        """
        lengths, matches = upload.episode_lengths, _matches(upload)
        if not len(lengths) and not matches:
            return ""
        rows = self._spec.collection.rollout_length * min(upload.identity.sequence + 1, _LOST * (actor.uploads + 1))
        if actor.environments == 1 or self._spec.algorithm.synchronous or self._spec.environment.is_game:
            rows += int(_CLIENT_ROWS * (now - actor.joined + _BEGIN_SECONDS))
        if actor.matches + matches > rows * 2 * actor.environments:  # as many copies of the game may only rate
            return f"it reports {matches} matches, and {actor.matches} before, but has played at most {rows} rows"
        longest, total = int(lengths.max(initial=0)), sum(lengths.tolist())
        if longest > rows or actor.episode_rows + total > rows * actor.environments:
            return (
                f"it reports episodes of {total} env_steps, the longest of {longest}, and {actor.episode_rows} before, "
                f"but the actor has played at most {rows} rows in each of its {actor.environments} environments"
            )
        environment = self._spec.environment
        if environment.reward_clip is None and environment.reward_scale:
            most = lengths * (1.001 * LARGEST_REWARD / abs(environment.reward_scale))
            if (np.abs(upload.episode_returns) > most).any():
                return f"episode_returns has a value that rewards within +-{LARGEST_REWARD:g} do not add up to"
        return ""

    def _check_identity(self, sender: str, rollout: Upload) -> Rejected | None:
        """Return a rejection if a rollout is for another learner epoch or from another incarnation, else None."""
        identity = rollout.identity
        if identity.learner_epoch != self._epoch:
            return Rejected(verdict="fenced", cause="epoch", reason="the rollout is for another learner epoch")
        if identity.actor != sender or self._fleet.find(identity) is None:
            reason = f"incarnation {identity.incarnation} of {identity.actor!r} is not the current one of {sender!r}"
            return Rejected(verdict="fenced", cause="unknown_actor", reason=reason)
        return None

    def _limits(self, spaces: Spaces, environments: int) -> Limits:
        """Return the size limits of an upload, from the specification and the actor's number of environments."""
        if self._spec.uploads_gradients:
            return gradient_limits(self._spec, self.gradient_shapes, spaces, environments)
        row = _ROW_BYTES + sum(spaces.masks.values()) + 8 * len(self._spec.lessons)  # an episode may be a row long
        for space in spaces.actions.values():
            row += space.size * (_INTEGER_BYTES if isinstance(space, DiscreteSpace) else 4)
        rows = self._spec.collection.rollout_length
        size = rows * row + 4 * self.state_size
        for space in spaces.observations.values():
            size += (rows + space.frames) * math.prod(space.shape) * np.dtype(space.dtype).itemsize
        arrays = (
            _OTHER_ARRAYS
            + len(spaces.observations)
            + 2 * len(spaces.actions)
            + MAX_INFO_NAMES
            + len(self._spec.lessons)
        )
        return Limits(max_bytes=environments * size + _SLACK_BYTES, max_arrays=arrays)

    def _first_violation(self, rollout: Upload, spaces: Spaces, actor: Actor) -> str:
        """Return a description of the first violation of the specification, or an empty string."""
        if isinstance(rollout, Gradient):
            shapes = self.gradient_shapes
            return gradient_violation(rollout, self._spec, shapes, spaces, actor.environments) or lessons_violation(
                rollout, self._spec
            )
        return (
            self._shape_violation(rollout, actor)
            or first_component_violation(rollout, spaces, self._spec.policy)
            or number_violation(rollout)
            or self._value_violation(rollout)
            or episode_violation(rollout, self._spec.algorithm.learns_overrides)
            or lessons_violation(rollout, self._spec)
        )

    def _shape_violation(self, rollout: Rollout, actor: Actor) -> str:
        rows = self._spec.collection.rollout_length
        if (rollout.rows, rollout.environments) != (rows, actor.environments):
            return (
                f"the rollout has {rollout.rows} rows of {rollout.environments} environments, "
                f"expected {rows} rows of {actor.environments} environments"
            )
        if rollout.initial_state.shape[1] != self.state_size:
            return f"initial_state has size {rollout.initial_state.shape[1]}, expected {self.state_size}"
        return ""

    def _value_violation(self, rollout: Rollout) -> str:
        environment = self._spec.environment
        if rollout.game_steps is not None and not environment.is_game:
            return "game_steps is set, but the run plays no game with several agents"
        sides = len(self._spec.league.sides) or 2
        if rollout.game_steps is not None and rollout.game_steps > rollout.agent_steps * sides:
            return (
                f"game_steps is {rollout.game_steps}, of {rollout.agent_steps} rows to learn from in a game with "
                f"{sides} sides: one row has at most as many steps"
            )
        if rollout.matches is not None:
            if self._league is None:
                return "matches is set, but the run plays no game with several agents"
            if violation := self._league.violation(rollout.matches):
                return violation
        if environment.reward_clip is not None:
            largest = environment.reward_clip * environment.reward_scale
            if np.abs(rollout.rewards).max() > np.float32(largest * (1 + 1e-5)):
                return f"rewards has a value outside the clip range of +-{largest:g}"
        return ""


def _matches(upload: Upload) -> int:
    """Return the number of matches that an upload reports."""
    counts = upload.matches.counts if isinstance(upload, Rollout) and upload.matches is not None else ()
    return sum(each.wins + each.draws + each.losses for each in counts)


def episode_violation(rollout: Rollout, teaches: bool = False) -> str:
    """Return where the rollout breaks gymnasium's NEXT_STEP rule, or reports other episodes than ended in it.

    `teaches`: the run learns from overridden rows.
    """
    if (rollout.episode_lengths < 1).any():
        return "episode_lengths has a value below 1"
    ends = rollout.terminated | rollout.truncated  # [T, E]
    if (ends & ~rollout.valid).any():
        return "an episode ends in a row that only resets"
    if rollout.overridden is not None and (rollout.overridden & ~rollout.valid).any():
        return "a row that only resets is overridden"
    if rollout.taught is not None and (rollout.overridden is None or (rollout.taught & ~rollout.overridden).any()):
        return "a row is taught that is not overridden"
    taught = teaches and rollout.taught is not None and rollout.taught.any()
    if rollout.overridden is not None and not rollout.learned.any() and not taught:
        return "every row is overridden: there is none to learn from"
    if (rollout.valid[1:] == ends[:-1]).any():
        return "valid breaks the reset rule: a row must be invalid if, and only if, an episode ended in the row before"
    reported, ended = len(rollout.episode_returns), np.count_nonzero(ends)
    if reported < ended or (reported > ended and rollout.game_steps is None):  # not every row of a game is sent
        return f"episode_returns has {reported} values, but {ended} episodes ended"
    return ""


def acknowledgement(verdict: Upload | Rejected, policy_version: int) -> Acknowledgement:
    """Return the answer to the sender. A long reason is cut."""
    if isinstance(verdict, Rejected):
        reason = bounded_text(verdict.reason, _MAX_REASON)
        return Acknowledgement(verdict=verdict.verdict, reason=reason, policy_version=policy_version)
    return Acknowledgement(verdict="accepted", policy_version=policy_version)
