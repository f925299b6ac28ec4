"""What a client, whose loop its user owns, reports about itself for the status."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientReport:
    """Counts of one process of a client so far. Client -> learner, on `reports/{actor}`.

    A client sends it every few seconds while the counts change. The answer is an Acknowledgement or a Refusal.
    """

    actor: str
    incarnation: int
    deadlines: int = 0  # of its clock; 0 without a clock
    missed_deadlines: int = 0
    overridden_actions: int = 0  # of a person or a safety filter, played in place of the policy's
    safe_actions: int = 0  # played because the policy was too old or untrained
    rollouts_dropped: int = 0  # finished or not, that were never sent
    safe_reason: str = ""  # why it plays the safe action now; empty while the policy acts
