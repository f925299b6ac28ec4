"""What is encoded comes back, in the bytes that are documented."""

import dataclasses
import struct
import threading
from typing import get_args

import msgpack
import numpy as np
import pytest
import zstandard
from hypothesis import given
from message_strategies import KINDS, messages, rollouts, snapshots
from wire_format import IDENTITY, LIMITS, SAMPLES, SNAPSHOT, arrays_of, repeatable, the_same, unwire

from protocol.codec import decode, encode
from protocol.messages import (
    Message,
    Program,
    Snapshot,
)


def test_every_kind_of_message_is_tried() -> None:
    assert set(KINDS) == set(get_args(Message))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_message_comes_back_bit_for_bit(kind: type) -> None:
    @repeatable
    @given(message=KINDS[kind])
    def returns(message: Message) -> None:
        assert the_same(decode(encode(message), LIMITS), message)

    returns()


@repeatable
@given(message=rollouts() | snapshots())
def test_decoded_arrays_are_read_only(message: Message) -> None:
    for array in arrays_of(decode(encode(message), LIMITS)):
        assert not array.flags.writeable
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.flags.writeable = True


@repeatable
@given(message=messages)
def test_encoding_is_a_function_of_the_message(message: Message) -> None:
    data = encode(message)
    assert encode(decode(data, LIMITS)) == data


def test_arrays_travel_whatever_their_memory_looks_like() -> None:
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    weights = {"turned": values.T, "stepped": values[:, ::-2], "big": values.astype(">f4"), "scalar": values[0, 0, 1]}
    came = decode(encode(dataclasses.replace(SNAPSHOT, weights=weights)), LIMITS)
    assert isinstance(came, Snapshot)
    for name, array in weights.items():
        assert came.weights[name].dtype == np.dtype("<f4")
        np.testing.assert_array_equal(came.weights[name], array)


@pytest.mark.parametrize("dtype", ["float64", "float16", "int8", "int16", "uint32", "uint64", "complex64", "O", "U3"])
def test_a_dtype_that_does_not_travel_is_our_own_fault(dtype: str) -> None:
    with pytest.raises(ValueError, match=r"weights/w.*does not travel"):
        encode(dataclasses.replace(SNAPSHOT, weights={"w": np.zeros(2, dtype)}))


def test_threads_may_encode_and_decode_at_once() -> None:
    """A zstd context shared by threads fails, or crashes, within a few of these."""
    failures: list[object] = []

    def work(value: int) -> None:
        model = np.tile(np.arange(value, value + 100, dtype=np.uint8), 5000)
        try:
            for _ in range(20):
                came = decode(encode(Program(hash="h", model=model)), LIMITS)
                assert isinstance(came, Program)
                assert came.model.tobytes() == model.tobytes()
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(value,)) for value in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()
    assert not failures


# --------------------------------------------------------------------------------- the layout, golden


def test_the_bytes_of_version_1_are_as_documented() -> None:
    header = msgpack.packb(
        {
            "kind": "Snapshot",
            "fields": {"learner_epoch": 1, "policy_version": 2, "program": "abc"},
            "arrays": [["weights/w", "<f4", [2, 2]], ["weights/b", "|u1", [3]]],
            "size": 24,
        }
    )
    assert header is not None
    padding = bytes(-(12 + len(header)) % 8)
    body = struct.pack("<4f", 1, 2, 3, 4) + bytes([1, 2, 3]) + bytes(5)
    expected = b"DAED" + struct.pack("<H", 1) + struct.pack("<H", 0) + struct.pack("<I", len(header))
    assert encode(SNAPSHOT) == expected + header + padding + body


def test_the_prefix_can_be_read_with_struct_alone() -> None:
    data = SAMPLES["rollout"]
    magic, version, flags, length = struct.unpack_from("<4sHHI", data)
    assert (magic, version, flags) == (b"DAED", 1, 1)
    content = msgpack.unpackb(data[12 : 12 + length])
    assert list(content) == ["kind", "fields", "arrays", "size"]
    assert content["kind"] == "Rollout"
    assert content["fields"] == {"identity": dataclasses.asdict(IDENTITY), "policy_version": 5}
    assert content["arrays"][0] == ["observations", "<f4", [9, 4, 3]]
    start = (12 + length + 7) // 8 * 8
    assert zstandard.ZstdDecompressor().decompress(data[start:]) == bytes(content["size"])


def test_a_body_that_would_not_shrink_travels_plain() -> None:
    noise = np.frombuffer(np.random.default_rng(0).bytes(1000), "|u1")
    assert unwire(encode(Program(hash="h", model=noise)))[0] == 0
    assert unwire(encode(Program(hash="h", model=np.zeros(1000, "|u1"))))[0] == 1
