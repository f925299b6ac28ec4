"""Messages that travel as objects: encoding and decoding would take most of the time of a simulation.

Compact snapshots are cut into parts of their bytes, so the codec encodes and decodes them.
"""

from daedalus.protocol import codec
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import CompactSnapshot, Message

SIZE = 100  # bytes of every message, for the bounds of queues


class Encoded(bytes):
    """Bytes that carry the message that they stand for."""

    message: Message


def encode(message: Message) -> bytes:
    """Return bytes that carry the message."""
    if isinstance(message, CompactSnapshot):
        return codec.encode(message)
    encoded = Encoded(SIZE)
    encoded.message = message
    return encoded


def decode(data: bytes, limits: Limits) -> Message:
    """Return the message that the bytes carry."""
    if isinstance(data, Encoded):
        return data.message
    return codec.decode(data, limits)
