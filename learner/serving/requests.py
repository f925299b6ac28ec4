"""Decoding of queries to the learner. A pure function."""

from typing import TypeVar

from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Refusal

Kind = TypeVar("Kind")


def read_request(payload: bytes, limits: Limits, *kinds: type[Kind]) -> Kind | Refusal:
    """Return the message of a query, or the Refusal of what is no message of these kinds."""
    try:
        message = decode(payload, limits)
    except ProtocolError as error:
        return Refusal(code="malformed", reason=str(error))
    if not isinstance(message, kinds):
        expected = " or ".join(kind.__name__ for kind in kinds)
        return Refusal(code="malformed", reason=f"expected {expected}, and not {type(message).__name__}")
    return message
