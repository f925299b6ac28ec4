"""Limits of each kind of message, checked before memory is allocated for it.

A reader decodes a message with the limits of the kind that it expects. The limits of a rollout depend on the run's
spec and are computed by the learner (learner/serving/rollout_judge.py).
"""

from dataclasses import dataclass

_PREFIX_BYTES = 32  # of every message, with the padding of the header, rounded up


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Largest sizes that a reader accepts; the defaults suit messages without large arrays.

    Attributes:
      max_bytes: bytes of the body after decompression; also of the whole message.
      max_header_bytes: bytes of the header.
      max_arrays: number of arrays.
    """

    max_bytes: int = 64 << 20
    max_header_bytes: int = 256 << 10
    max_arrays: int = 4096

    @property
    def message_bytes(self) -> int:
        """Largest size of an encoded message, in bytes."""
        return self.max_bytes + self.max_header_bytes + _PREFIX_BYTES


# Read by the learner; a larger message is malformed.
JOIN_LIMITS = Limits(max_bytes=0, max_arrays=0)  # names and spaces, no arrays
STATUS_REQUEST_LIMITS = Limits(max_bytes=0, max_header_bytes=1 << 10, max_arrays=0)  # a name
CLIENT_REPORT_LIMITS = Limits(max_bytes=0, max_header_bytes=2 << 10, max_arrays=0)  # names, counts and a reason
SNAPSHOT_REQUEST_LIMITS = Limits(max_bytes=0, max_header_bytes=1 << 10, max_arrays=0)  # a name and three numbers
EVALUATION_LIMITS = Limits(max_bytes=1 << 20, max_header_bytes=16 << 10, max_arrays=2)  # returns and lengths

# Read by actors and evaluators.
ACKNOWLEDGEMENT_LIMITS = Limits(max_bytes=0, max_header_bytes=16 << 10, max_arrays=0)  # a verdict and a reason
SNAPSHOT_PART_LIMITS = Limits(max_bytes=1 << 20, max_header_bytes=16 << 10, max_arrays=1)  # one small piece
LEARNER_LIMITS = Limits(max_bytes=1 << 30)  # any message of the learner: weights and programs may be large

# Read by operators.
STATUS_LIMITS = Limits(max_bytes=0, max_arrays=0)  # one page of actors
METRICS_LIMITS = Limits(max_bytes=1 << 20, max_arrays=2)  # one page of rows
