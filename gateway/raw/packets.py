"""The packets between a gateway and clients that run the policy themselves, and their encoding. Pure.

Each end first sends the four bytes b"DBR1", then packets:

    offset  bytes
         0      4  length of the payload, little-endian like all numbers here
         4      1  kind
         5      1  length of the key
         6      2  timeout of a query in milliseconds; otherwise 0
         8      4  number that the client chooses; packets that belong to a query, FOLLOW or WATCH repeat its number
        12      -  key, ASCII
         -      -  payload
"""

import enum
import re
import struct
from typing import NamedTuple

GREETING = b"DBR1"
HEADER_BYTES = 12
MAX_QUERY_BYTES = 64 << 20  # payload of a query
MAX_ANSWER_BYTES = 1 << 30  # payload to a client: weights may be large

_HEADER = struct.Struct("<IBBHI")
_CHUNK = r"(?:[A-Za-z0-9][A-Za-z0-9._-]{0,63}|\*)"
_KEY = re.compile(rf"daedalus(?:/{_CHUNK}){{1,4}}")


class Kind(enum.IntEnum):
    """Kind of a packet."""

    QUERY = 1  # client: sends a query to the servers of the key
    FOLLOW = 2  # client: subscribes to the key
    ANNOUNCE = 3  # client: declares presence under the key until its connection ends
    WATCH = 4  # client: watches presence under the key
    ANSWER = 5  # gateway: one answer to a query
    END = 6  # gateway: the query has no more answers
    NEWS = 7  # gateway: the newest value of a key that the client follows
    PRESENT = 8  # gateway: the packet's key has become present
    ABSENT = 9  # gateway: the packet's key is no longer present
    ERROR = 10  # gateway: the reason, as text, why it closes the connection


_PATTERNS = (Kind.QUERY, Kind.WATCH)  # whose key may contain `*`


class PacketError(Exception):
    """The client sent an invalid packet: a fault of the client."""


class Packet(NamedTuple):
    """One message between the gateway and a client."""

    kind: Kind
    number: int
    key: str = ""
    timeout: float = 0.0  # seconds
    payload: bytes = b""


class Header(NamedTuple):
    """The validated first bytes of a client's packet."""

    kind: Kind
    number: int
    timeout: float
    key_bytes: int
    payload_bytes: int


def encode_packet(packet: Packet) -> bytes:
    """Return the bytes of a packet."""
    return encode_head(packet) + packet.payload


def encode_head(packet: Packet) -> bytes:
    """Return the bytes of a packet before its payload."""
    key, milliseconds = packet.key.encode("ascii"), round(packet.timeout * 1000)
    return _HEADER.pack(len(packet.payload), packet.kind, len(key), milliseconds, packet.number) + key


def fits_packet(key: str) -> bool:
    """Return whether a packet can hold a key that another process declared."""
    return key.isascii() and len(key) <= 255


def read_header(data: bytes) -> Header:
    """Return the header of a client's packet. Raises PacketError if it is not valid."""
    payload_bytes, kind, key_bytes, milliseconds, number = _HEADER.unpack(data)
    if not Kind.QUERY <= kind <= Kind.WATCH:
        raise PacketError(f"packet kind {kind} is not one that a client sends")
    limit = MAX_QUERY_BYTES if kind == Kind.QUERY else 0
    if payload_bytes > limit:
        raise PacketError(f"the payload has {payload_bytes} bytes, the limit is {limit}")
    return Header(Kind(kind), number, milliseconds / 1000, key_bytes, payload_bytes)


def is_own_key(key: str, name: str) -> bool:
    """Return whether a client may use a key if it may act only as `name` and as NAME.ANYTHING."""
    kind, *rest = key.split("/")[2:] or [""]
    if kind in ("join", "rollouts", "reports", "evaluations", "actors"):
        return bool(rest) and (rest[0] == name or rest[0].startswith(f"{name}."))
    return kind in ("program", "snapshots", "end", "learner")


def check_key(data: bytes, kind: Kind) -> str:
    """Return the key of a client's packet. Raises PacketError if it is not valid.

    The gateway gives access to keys under `daedalus/` only: Zenoh's routers expose their settings under other keys.
    """
    key = data.decode("ascii", "replace")
    if not _KEY.fullmatch(key) or ("*" in key and kind not in _PATTERNS):
        raise PacketError(f"the key of {kind.name} is not valid: {key[:64]!r}")
    return key
