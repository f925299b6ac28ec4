"""Memory that a hostile message can make its reader allocate."""

import dataclasses
import struct
import tracemalloc
from typing import Any

import msgpack
import numpy as np
import pytest
import zstandard
from wire_format import (
    JOIN,
    LIMITS,
    PREFIX,
    SAMPLES,
    SNAPSHOT,
    WELCOME,
    decoded_or_refused,
    unwire,
    wire,
    wire_header,
)

from daedalus.protocol.codec import PROTOCOL_VERSION, ProtocolError, decode, encode
from daedalus.protocol.limits import LEARNER_LIMITS, Limits
from daedalus.protocol.messages import Program, Refusal, RunEnded, Snapshot


def peak_bytes(data: bytes, limits: Limits) -> int:
    """Return the peak memory of rejecting `data`."""
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError):
            decode(data, limits)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def zeros_frame(size: int, *, declared: bool) -> bytes:
    """Return a zstd frame of `size` zeros, without allocating them."""
    compressor = zstandard.ZstdCompressor().compressobj(size=size if declared else -1)
    chunk = bytes(1 << 20)
    return b"".join(compressor.compress(chunk) for _ in range(size >> 20)) + compressor.flush()


BOMB = 256 << 20
SMALL = Limits(max_bytes=1 << 20, max_header_bytes=4096, max_arrays=4)


def bomb(frame: bytes, size: int) -> bytes:
    """Return a Program message, which may be compressed, of `size` bytes."""
    _, content, _ = unwire(encode(Program(hash="", model=np.zeros(1, np.uint8))))
    content.update(arrays=[["model", "|u1", [size], False]], size=size)
    return wire(content, frame, flags=1)


def test_frame_that_declares_more_than_the_header_is_not_decompressed() -> None:
    frame = zeros_frame(BOMB, declared=True)
    assert len(frame) < 1 << 20
    assert peak_bytes(bomb(frame, 1 << 16), SMALL) < 2 << 20
    assert peak_bytes(bomb(frame, BOMB), SMALL) < 2 << 20


def test_frame_without_a_declared_size_is_not_decompressed() -> None:
    assert peak_bytes(bomb(zeros_frame(BOMB, declared=False), 1 << 16), SMALL) < 2 << 20


def test_frame_is_not_decompressed_beyond_its_declared_size() -> None:
    frame = zeros_frame(BOMB, declared=True)
    lie = frame.replace(struct.pack("<I", BOMB), struct.pack("<I", 1 << 16), 1)
    assert lie != frame
    assert zstandard.frame_content_size(lie) == 1 << 16
    assert peak_bytes(bomb(lie, 1 << 16), SMALL) < 2 << 20


@pytest.mark.parametrize("name", [name for name in SAMPLES if name not in ("rollout", "pixels", "program")])
def test_kinds_that_are_never_compressed_are_not_decompressed(name: str) -> None:
    _, content, body = unwire(SAMPLES[name])
    frame = zstandard.ZstdCompressor().compress(bytes(body))
    with pytest.raises(ProtocolError, match="must not be compressed"):
        decode(wire(content, frame, flags=1), LIMITS)


def test_frame_smaller_than_declared_is_rejected() -> None:
    frame = zstandard.ZstdCompressor().compress(bytes(1 << 16))
    assert isinstance(decode(bomb(frame, 1 << 16), LIMITS), Program)
    for body in (frame[:-4], frame + frame, frame + b"x", b"", b"not zstd", bytes(8)):
        with pytest.raises(ProtocolError):
            decode(bomb(body, 1 << 16), LIMITS)


@pytest.mark.parametrize(
    "header",
    [
        b"\xdd\xff\xff\xff\xff",  # list of 2^32 - 1
        b"\xdf\xff\xff\xff\xff",  # map
        b"\xdb\xff\xff\xff\xff",  # text
        b"\xc6\xff\xff\xff\xff",  # bytes
        b"\xc9\xff\xff\xff\xff\x01",  # extension
        b"\xdd\x00\xff\xff\xff" * 100,  # lists in lists
        b"\xc4\x04abcd",  # any bytes
        b"\xd6\x01abcd",  # any extension
        b"\xd6\xffabcd",  # a timestamp
        b"\xa2\xff\xff",  # text that is not UTF-8
        b"\xc1",  # never used
        b"\x91" * 4000,  # deep
        b"\x81\xa1a" * 1300,  # deep
        b"\x81\x90\x01",  # a list as a key
        b"\x81\x01\x01",  # a number as a key
        b"\x80\x80",  # two values
    ],
)
def test_header_with_huge_declared_sizes_allocates_nothing(header: bytes) -> None:
    assert peak_bytes(wire_header(header), SMALL) < 1 << 20


@pytest.mark.parametrize("depth", [100, 254, 255, 400, 500, 511, 512, 2000])
def test_deep_nesting_is_decoded_or_rejected(depth: int) -> None:
    _, content, _ = unwire(encode(WELCOME))
    for opening, closing in ((b"\x91", b""), (b"\x81\xa1a", b"")):
        nested = opening * depth + b"\x01" + closing
        content["fields"]["spec"]["environment"]["kwargs"] = {"a": "HERE"}
        header = (msgpack.packb(content) or b"").replace(b"\xa4HERE", nested)
        decoded_or_refused(wire_header(header))


@pytest.mark.parametrize(
    "spaces",
    [
        {"observations": {"o": {"kind": "discrete", "counts": ["x"] * 120_000}}},
        {"observations": {"o": {"kind": "array", "shape": ["x"] * 120_000, "dtype": "uint8"}}},
        {"actions": {"a": {"kind": "continuous", "low": ["x"] * 60_000, "high": ["x"] * 60_000}}},
        {"observations": {f"!{index}": 1 for index in range(30_000)}},
        {str(index): 1 for index in range(30_000)},
    ],
    ids=["counts", "shape", "bounds", "names", "keys"],
)
def test_many_faults_cost_little_memory(spaces: dict[str, Any]) -> None:
    """A description of each would take 180 MB, and half a second in which no other thread runs."""
    _, content, _ = unwire(SAMPLES["join"])
    content["fields"]["spaces"] = {"observations": {}, "actions": {}} | spaces
    assert peak_bytes(wire(content), LIMITS) < 16 << 20


def test_header_beyond_the_limit_is_not_read() -> None:
    _, content, _ = unwire(encode(RunEnded(learner_epoch=1, outcome="finished", reason="x" * 5000)))
    with pytest.raises(ProtocolError, match=r"the header declares .* the limit is 4096"):
        decode(wire(content), SMALL)
    with pytest.raises(ProtocolError, match="the header declares 4294967295 bytes"):
        decode(PREFIX.pack(b"DAED", PROTOCOL_VERSION, 0, 2**32 - 1), SMALL)


def test_header_that_no_reader_accepts_is_not_encoded() -> None:
    refusal = Refusal(code="unknown", reason="x" * (LEARNER_LIMITS.max_header_bytes - 1000))
    assert decode(encode(refusal), LEARNER_LIMITS) == refusal
    with pytest.raises(ValueError, match=r"the header of a Refusal has 26\d,\d\d\d bytes, readers accept 262,144"):
        encode(dataclasses.replace(refusal, reason="x" * LEARNER_LIMITS.max_header_bytes))


def test_more_arrays_than_the_limit_are_rejected() -> None:
    many = {f"w{index}": np.zeros(1, np.float32) for index in range(5)}
    data = encode(dataclasses.replace(SNAPSHOT, weights=many))
    decode(data, LIMITS)
    with pytest.raises(ProtocolError, match="5 arrays, the limit is 4"):
        decode(data, SMALL)


def test_body_at_the_limit_is_accepted_and_a_larger_one_rejected() -> None:
    limits = Limits(max_bytes=4096)
    for count, kind in ((1024, Snapshot), (1026, None)):
        data = encode(dataclasses.replace(SNAPSHOT, weights={"w": np.zeros(count, np.float32)}))
        if kind is None:
            with pytest.raises(ProtocolError, match="the limit is 4096"):
                decode(data, limits)
        else:
            assert isinstance(decode(data, limits), kind)
    with pytest.raises(ProtocolError, match=r"a message of .* bytes, the limit is 4096"):
        decode(SAMPLES["snapshot"] + bytes(5000), limits)


def test_header_at_the_limit_is_read() -> None:
    length = PREFIX.unpack_from(SAMPLES["join"])[3]
    assert decode(SAMPLES["join"], Limits(max_header_bytes=length)) == JOIN
    with pytest.raises(ProtocolError, match=f"the header declares {length} bytes, the limit is {length - 1}"):
        decode(SAMPLES["join"], Limits(max_header_bytes=length - 1))
