"""One version of a policy, ready to act."""

from dataclasses import dataclass

from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.messages import Welcome


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class PolicyVersion:
    """Weights in a runtime. Several versions act in turn: a client keeps one for a whole rollout."""

    session: Welcome  # of the learner epoch that it belongs to
    version: int
    runtime: OnnxRuntime
    size: int  # of the weights, in bytes
