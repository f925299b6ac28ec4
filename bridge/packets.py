"""What travels between the bridge and its client, and how. Pure functions; this file knows no socket.

Each end first sends the four bytes b"DBR1", then packets:

    offset  bytes
         0      4  length of the payload, little-endian like all numbers here
         4      1  kind
         5      1  length of the key
         6      2  timeout in milliseconds, of a query; else 0
         8      4  number: the client's choice; what the bridge sends of a question, follow or watch bears its number
        12      -  key, ASCII
         -      -  payload
"""

import enum
import re
import struct
from typing import NamedTuple

GREETING = b"DBR1"
HEADER_BYTES = 12
MAX_QUESTION_BYTES = 64 << 20  # of what a client sends
MAX_ANSWER_BYTES = 1 << 30  # of what it is sent: weights may be large

_HEADER = struct.Struct("<IBBHI")
_CHUNK = r"(?:[A-Za-z0-9][A-Za-z0-9._-]{0,63}|\*)"
_KEY = re.compile(rf"daedalus(?:/{_CHUNK}){{1,4}}")


class Kind(enum.IntEnum):
    """What a packet is for."""

    QUERY = 1  # client: asks whoever serves the key
    FOLLOW = 2  # client: wants what is published under the key
    ANNOUNCE = 3  # client: is present under the key until its connection ends
    WATCH = 4  # client: wants to know who is present under the key
    ANSWER = 5  # bridge: one answer to a query
    END = 6  # bridge: the query has no more answers
    NEWS = 7  # bridge: the newest value of a followed key
    PRESENT = 8  # bridge: somebody is there, under the key that the packet bears
    ABSENT = 9  # bridge: they have gone
    ERROR = 10  # bridge: why it closes the connection, as text


_PATTERNS = (Kind.QUERY, Kind.WATCH)  # may bear a key with `*` in it


class PacketError(Exception):
    """The client sent what is no packet; its fault."""


class Packet(NamedTuple):
    """One of them."""

    kind: Kind
    number: int
    key: str = ""
    timeout: float = 0.0  # seconds
    payload: bytes = b""


class Header(NamedTuple):
    """The first bytes of a packet, checked."""

    kind: Kind
    number: int
    timeout: float
    key_bytes: int
    payload_bytes: int


def encode_packet(packet: Packet) -> bytes:
    """The bytes of a packet."""
    key, milliseconds = packet.key.encode("ascii"), round(packet.timeout * 1000)
    return _HEADER.pack(len(packet.payload), packet.kind, len(key), milliseconds, packet.number) + key + packet.payload


def read_header(data: bytes) -> Header:
    """The header of a packet from a client; raises PacketError."""
    payload_bytes, kind, key_bytes, milliseconds, number = _HEADER.unpack(data)
    if not Kind.QUERY <= kind <= Kind.WATCH:
        raise PacketError(f"kind {kind} is not one that a client sends")
    most = MAX_QUESTION_BYTES if kind == Kind.QUERY else 0
    if payload_bytes > most:
        raise PacketError(f"a payload of {payload_bytes} bytes, the limit is {most}")
    return Header(Kind(kind), number, milliseconds / 1000, key_bytes, payload_bytes)


def check_key(data: bytes, kind: Kind) -> str:
    """The key of a packet from a client; raises PacketError.

    Nothing outside `daedalus/` is reached through a bridge, least of all the routers' own settings.
    """
    key = data.decode("ascii", "replace")
    if not _KEY.fullmatch(key) or ("*" in key and kind not in _PATTERNS):
        raise PacketError(f"{kind.name} has no proper key: {key[:64]!r}")
    return key
