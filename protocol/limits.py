"""What a message may ask of its reader, by kind of message: held before memory is allocated for it."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What a message may ask of its reader before anything is known about it.

    Attributes:
      max_bytes: largest body after decompression; also the largest message.
      max_header_bytes: largest header.
      max_arrays: most arrays in one message.
    """

    max_bytes: int = 64 << 20
    max_header_bytes: int = 256 << 10
    max_arrays: int = 4096
