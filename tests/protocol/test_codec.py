"""The wire format: what goes in comes out, and nothing that comes in breaks the reader."""

import copy
import dataclasses
import struct
import threading
import tracemalloc
from collections.abc import Callable
from typing import Any, get_args

import msgpack
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.codec import PROTOCOL_VERSION, Limits, ProtocolError, VersionMismatchError, decode, encode
from protocol.messages import (
    Acknowledgement,
    Farewell,
    Join,
    Message,
    Program,
    Refusal,
    Rollout,
    RolloutIdentity,
    Snapshot,
    StatusReport,
    Welcome,
)
from protocol.spec import (
    ActorStatus,
    ArraySpace,
    ChoiceSpace,
    CollectionSpec,
    EnvironmentSpec,
    PolicySpec,
    RunSpec,
    RunStatus,
    ServiceSpec,
    Spaces,
    TrainingSpec,
)

LIMITS = Limits()
PREFIX = struct.Struct("<4sHHI")
DTYPES = ("<f4", "|u1", "|b1", "<u2", "<i4", "<i8")
repeatable = settings(max_examples=60, deadline=None, derandomize=True)

# ------------------------------------------------------------------------- the format, written by hand


def wire(content: Any, body: bytes = b"", *, flags: int = 0, version: int = PROTOCOL_VERSION) -> bytes:
    """A message from the content of its header."""
    return wire_header(msgpack.packb(content) or b"", body, flags=flags, version=version)


def wire_header(header: bytes, body: bytes = b"", *, flags: int = 0, version: int = PROTOCOL_VERSION) -> bytes:
    prefix = PREFIX.pack(b"DAED", version, flags, len(header))
    return prefix + header + bytes(-(len(prefix) + len(header)) % 8) + body


def unwire(data: bytes) -> tuple[int, dict[str, Any], bytes]:
    """Flags, header content and body of a message."""
    magic, version, flags, length = PREFIX.unpack_from(data)
    assert (magic, version) == (b"DAED", PROTOCOL_VERSION)
    end = PREFIX.size + length
    start = end + -end % 8
    assert not any(data[end:start])
    return flags, msgpack.unpackb(data[PREFIX.size : end]), data[start:]


def bits(random: np.random.Generator, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """Any bit pattern of a dtype, NaNs and infinities among them."""
    if dtype == "|b1":
        return random.integers(0, 2, shape).astype(np.bool_)
    count = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return np.frombuffer(random.bytes(count), dtype).reshape(shape)


def the_same(left: Any, right: Any) -> bool:
    """Equality of messages, their arrays bit for bit."""
    if type(left) is not type(right):
        return False
    if isinstance(left, np.ndarray):
        return (left.dtype, left.shape, left.tobytes()) == (right.dtype, right.shape, right.tobytes())
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(the_same(left[key], right[key]) for key in left)
    if dataclasses.is_dataclass(left):
        names = [field.name for field in dataclasses.fields(left)]
        return all(the_same(getattr(left, name), getattr(right, name)) for name in names)
    return left == right


def arrays_of(message: Message) -> list[np.ndarray]:
    values = [getattr(message, field.name) for field in dataclasses.fields(message)]
    values += [array for value in values if isinstance(value, dict) for array in value.values()]
    return [value for value in values if isinstance(value, np.ndarray)]


def decoded_or_refused(data: bytes, limits: Limits = LIMITS) -> None:
    """Anything but a message or a ProtocolError fails the test that calls this."""
    try:
        message = decode(data, limits)
    except ProtocolError as error:
        assert str(error)
    else:
        assert isinstance(message, Message)


# ---------------------------------------------------------------------------------------- strategies

text = st.text(max_size=20)
counters = st.integers(0, 2**63 - 1)
positive = st.integers(1, 10_000)
floats = st.floats(allow_nan=False)
generators = st.integers(0, 2**32).map(np.random.default_rng)
spaces = st.builds(
    Spaces,
    observation=st.builds(
        ArraySpace, shape=st.lists(positive, max_size=4).map(tuple), dtype=st.sampled_from(["float32", "uint8"])
    ),
    action=st.builds(ChoiceSpace, count=st.integers(1, 65_536)),
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | floats | text,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(text, inner, max_size=3),
    max_leaves=6,
)
run_specs = st.builds(
    RunSpec,
    environment=st.builds(
        EnvironmentSpec,
        id=st.text(min_size=1, max_size=20),
        kwargs=st.dictionaries(text, json_values, max_size=3),
        max_episode_steps=st.none() | positive,
        reward_scale=st.floats(1e-6, 1e6),
    ),
    policy=st.builds(
        PolicySpec,
        hidden=st.lists(positive, min_size=1, max_size=8).map(tuple),
        activation=st.sampled_from(["tanh", "relu"]),
    ),
    collection=st.builds(CollectionSpec, actors=positive, window=st.integers(1, 64)),
    training=st.builds(
        TrainingSpec,
        algorithm=st.sampled_from(["a2c", "a3c", "impala"]),
        seed=st.integers(0, 2**32 - 1),
        target_return=st.none() | floats,
        discount_factor=st.floats(0, 1),
        learning_rate_final=st.none() | st.floats(0, 1),
    ),
    service=st.builds(ServiceSpec, log_seconds=st.floats(0.01, 100)),
)
statuses = st.builds(
    RunStatus,
    episode_return_mean=st.none() | floats,
    actors=st.lists(
        st.builds(ActorStatus, actor=text, rollouts_rejected=st.dictionaries(text, counters, max_size=3)), max_size=3
    ).map(tuple),
    **dict.fromkeys(("run", "algorithm", "environment"), text),
    **dict.fromkeys(("learner_epoch", "env_steps", "env_steps_budget", "updates"), counters),
    **dict.fromkeys(("uptime_seconds", "env_steps_per_second", "updates_per_second", "policy_lag_mean"), floats),
)


@st.composite
def rollouts(draw: st.DrawFn) -> Rollout:
    random = draw(generators)
    rows, environments = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    episodes = draw(st.integers(0, rows * environments))
    observation = (rows + 1, environments, *draw(st.lists(st.integers(1, 5), min_size=1, max_size=3)))
    shape = (rows, environments)
    return Rollout(
        identity=draw(
            st.builds(RolloutIdentity, actor=text, incarnation=counters, sequence=counters, learner_epoch=counters)
        ),
        policy_version=draw(counters),
        observations=bits(random, draw(st.sampled_from(["<f4", "|u1"])), observation),
        actions=bits(random, draw(st.sampled_from(["|u1", "<u2", "<i4", "<i8"])), shape),
        behaviour_log_probs=bits(random, "<f4", shape),
        rewards=bits(random, "<f4", shape),
        terminated=bits(random, "|b1", shape),
        truncated=bits(random, "|b1", shape),
        valid=bits(random, "|b1", shape),
        episode_returns=bits(random, "<f4", (episodes,)),
        episode_lengths=bits(random, "<i4", (episodes,)),
    )


@st.composite
def snapshots(draw: st.DrawFn) -> Snapshot:
    random = draw(generators)
    shapes = st.lists(st.integers(0, 6), max_size=4).map(tuple)
    layout = draw(st.dictionaries(text, st.tuples(st.sampled_from(DTYPES), shapes), max_size=6))
    weights = {name: bits(random, dtype, shape) for name, (dtype, shape) in layout.items()}
    return Snapshot(learner_epoch=draw(counters), policy_version=draw(counters), program=draw(text), weights=weights)


KINDS: dict[type, st.SearchStrategy[Any]] = {
    Join: st.builds(
        Join, actor=text, incarnation=counters, spaces=st.none() | spaces, environments=st.integers(0, 4096)
    ),
    Welcome: st.builds(Welcome, run=text, learner_epoch=counters, seed=counters, spec=run_specs),
    Refusal: st.builds(Refusal, reason=text),
    Program: st.builds(Program, hash=text, model=st.binary(max_size=300).map(lambda data: np.frombuffer(data, "|u1"))),
    Rollout: rollouts(),
    Acknowledgement: st.builds(Acknowledgement, reason=text, policy_version=counters),
    Snapshot: snapshots(),
    Farewell: st.builds(Farewell, learner_epoch=counters, reason=text),
    StatusReport: st.builds(StatusReport, status=statuses),
}
messages = st.one_of(*KINDS.values())

IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=2, learner_epoch=3)
JOIN = Join(
    actor="a",
    incarnation=7,
    spaces=Spaces(observation=ArraySpace(shape=(4,), dtype="float32"), action=ChoiceSpace(count=2)),
)
SNAPSHOT = Snapshot(
    learner_epoch=1,
    policy_version=2,
    program="abc",
    weights={"w": np.array([[1.0, 2.0], [3.0, 4.0]], np.float32), "b": np.array([1, 2, 3], np.uint8)},
)
WELCOME = Welcome(run="r", learner_epoch=1, seed=1, spec=RunSpec(environment=EnvironmentSpec(id="x")))
STATUS = wire(  # every field of a status, as another implementation could write it
    {
        "kind": "StatusReport",
        "fields": {
            "status": {
                **dict.fromkeys(("run", "algorithm", "environment"), "x"),
                **dict.fromkeys(("learner_epoch", "env_steps", "env_steps_budget", "updates"), 1),
                **dict.fromkeys(("uptime_seconds", "env_steps_per_second", "updates_per_second"), 1.0),
                "policy_lag_mean": 0.0,
                "episode_return_mean": None,
                "actors": [],
            }
        },
        "arrays": [],
        "size": 0,
    }
)


def some_rollout() -> Rollout:
    rows = np.zeros((8, 4))
    return Rollout(
        identity=IDENTITY,
        policy_version=5,
        observations=np.zeros((9, 4, 3), np.float32),
        actions=rows.astype(np.int64),
        behaviour_log_probs=rows.astype(np.float32),
        rewards=rows.astype(np.float32),
        terminated=rows.astype(np.bool_),
        truncated=rows.astype(np.bool_),
        valid=rows.astype(np.bool_),
        episode_returns=np.zeros(1, np.float32),
        episode_lengths=np.zeros(1, np.int32),
    )


SAMPLES = {"join": encode(JOIN), "snapshot": encode(SNAPSHOT), "rollout": encode(some_rollout()), "status": STATUS}

# --------------------------------------------------------------------------------------- round trips


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
    rollout, failures = some_rollout(), []

    def work() -> None:
        for _ in range(50):
            if not the_same(decode(encode(rollout), LIMITS), rollout):
                failures.append("changed")

    threads = [threading.Thread(target=work) for _ in range(4)]
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


# ------------------------------------------------------------------------------------- damaged bytes


@pytest.mark.parametrize("name", SAMPLES)
def test_a_message_cut_at_any_length_is_refused(name: str) -> None:
    data = SAMPLES[name]
    decode(data, LIMITS)
    for length in range(len(data)):
        with pytest.raises(ProtocolError):
            decode(data[:length], LIMITS)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_message_with_something_after_it_is_refused(name: str) -> None:
    for extra in (b"\0", b"\0" * 8, SAMPLES[name]):
        if name in ("join", "status"):  # without a body: what follows would be one
            extra = extra.rjust(16, b"\0")
        with pytest.raises(ProtocolError):
            decode(SAMPLES[name] + extra, LIMITS)


@pytest.mark.parametrize("name", SAMPLES)
def test_no_flipped_bit_raises_anything_but_a_protocol_error(name: str) -> None:
    for position in range(len(SAMPLES[name])):
        for bit in range(8):
            data = bytearray(SAMPLES[name])
            data[position] ^= 1 << bit
            decoded_or_refused(bytes(data))


@repeatable
@given(data=st.binary(max_size=200))
def test_random_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        decode(data, LIMITS)


@repeatable
@given(header=st.binary(max_size=100), body=st.binary(max_size=64), flags=st.integers(0, 2))
def test_random_headers_are_refused(header: bytes, body: bytes, flags: int) -> None:
    with pytest.raises(ProtocolError):
        decode(wire_header(header, body, flags=flags), LIMITS)


@settings(repeatable, max_examples=300)
@given(
    message=messages,
    edits=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 3), st.binary(max_size=8)), min_size=1, max_size=5),
)
def test_edited_messages_are_decoded_or_refused(message: Message, edits: list[tuple[int, int, bytes]]) -> None:
    data = encode(message)
    for position, removed, inserted in edits:
        start = position % (len(data) + 1)
        data = data[:start] + inserted + data[start + removed :]
    decoded_or_refused(data)


anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.integers(-1, 3)
    | st.floats()
    | text
    | st.binary(max_size=2)
    | st.sampled_from([*DTYPES, "<f8", "O", "weights/w", 1 << 26, 1 << 40]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(text | st.just(b""), inner, max_size=3),
    max_leaves=8,
)


@settings(repeatable, max_examples=400)
@given(message=messages, choices=st.lists(st.integers(0, 30), min_size=8, max_size=8), value=anything)
def test_a_header_with_any_value_anywhere_is_decoded_or_refused(
    message: Message, choices: list[int], value: Any
) -> None:
    flags, content, body = unwire(encode(message))
    node: Any = content
    for choice in choices:  # walks down to some entry of the header and puts the value there
        entries = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = entries[choice % len(entries)]
        if choice > 24 or not isinstance(node[key], dict | list) or not node[key]:
            break
        node = node[key]
    node[key] = value
    decoded_or_refused(wire(content, body, flags=flags))


# ------------------------------------------------------------------------------- one fault at a time

Edit = Callable[[dict[str, Any]], object]
SNAPSHOT_FAULTS: dict[str, tuple[Edit, str]] = {
    "unknown kind": (lambda c: c.update(kind="Pickle"), "unknown kind"),
    "kind of another type": (lambda c: c.update(kind=["Snapshot"]), "unknown kind"),
    "field missing": (lambda c: c["fields"].pop("program"), "field 'program' is missing"),
    "field unknown": (lambda c: c["fields"].update(extra=1), "unknown field 'extra'"),
    "text for a number": (lambda c: c["fields"].update(learner_epoch="1"), "'learner_epoch' must be int, not str"),
    "bool for a number": (lambda c: c["fields"].update(learner_epoch=True), "'learner_epoch' must be int, not bool"),
    "float for a number": (lambda c: c["fields"].update(learner_epoch=1.0), "'learner_epoch' must be int, not float"),
    "nil for a number": (lambda c: c["fields"].update(learner_epoch=None), "'learner_epoch' must be int"),
    "number for text": (lambda c: c["fields"].update(program=1), "'program' must be str, not int"),
    "negative number": (lambda c: c["fields"].update(policy_version=-1), "from 0 to"),
    "number of 64 bits": (lambda c: c["fields"].update(policy_version=2**63), "from 0 to"),
    "fields not a map": (lambda c: c.update(fields=[]), "wrong type"),
    "arrays not a list": (lambda c: c.update(arrays={}), "wrong type"),
    "size not a number": (lambda c: c.update(size="24"), "wrong type"),
    "size a bool": (lambda c: c.update(size=True), "wrong type"),
    "size negative": (lambda c: c.update(size=-8), "wrong type"),
    "header entry missing": (lambda c: c.pop("size"), "exactly kind, fields, arrays and size"),
    "header entry unknown": (lambda c: c.update(more=1), "exactly kind, fields, arrays and size"),
    "array nobody knows": (lambda c: c["arrays"][0].__setitem__(0, "gradients/w"), "has no array 'gradients/w'"),
    "array twice": (lambda c: c["arrays"][1].__setitem__(0, "weights/w"), "distinct"),
    "array name a number": (lambda c: c["arrays"][0].__setitem__(0, 1), "distinct strings"),
    "array without a shape": (lambda c: c["arrays"][0].pop(), "a name, a dtype and a shape"),
    "array a map": (lambda c: c["arrays"].__setitem__(0, {}), "a name, a dtype and a shape"),
    "dtype float64": (lambda c: c["arrays"][0].__setitem__(1, "<f8"), "does not travel"),
    "dtype object": (lambda c: c["arrays"][0].__setitem__(1, "|O"), "does not travel"),
    "dtype big-endian": (lambda c: c["arrays"][0].__setitem__(1, ">f4"), "does not travel"),
    "dtype a list": (lambda c: c["arrays"][0].__setitem__(1, ["<f4"]), "does not travel"),
    "shape a number": (lambda c: c["arrays"][0].__setitem__(2, 4), "no proper shape"),
    "side negative": (lambda c: c["arrays"][0].__setitem__(2, [-2, -2]), "no proper shape"),
    "side -1": (lambda c: c["arrays"][0].__setitem__(2, [2, -1]), "no proper shape"),
    "side a float": (lambda c: c["arrays"][0].__setitem__(2, [2.0, 2]), "no proper shape"),
    "side NaN": (lambda c: c["arrays"][0].__setitem__(2, [float("nan"), 2]), "no proper shape"),
    "side a bool": (lambda c: c["arrays"][0].__setitem__(2, [True, 4]), "no proper shape"),
    "side too long": (lambda c: c["arrays"][0].__setitem__(2, [2**40, 2]), "no proper shape"),
    "too many dimensions": (lambda c: c["arrays"][0].__setitem__(2, [1] * 9), "no proper shape"),
    "shape larger than the body": (lambda c: c["arrays"][0].__setitem__(2, [2, 200]), "the body declares 24"),
    "product of sides huge": (lambda c: c["arrays"][0].__setitem__(2, [1 << 26] * 8), "the body declares 24"),
    "size less than the arrays": (lambda c: c.update(size=16), "the body declares 16"),
    "size beyond the limit": (lambda c: c.update(size=LIMITS.max_bytes + 8), "the limit is"),
    "size of 64 bits": (lambda c: c.update(size=2**64 - 1), "the limit is"),
}


@pytest.mark.parametrize("fault", SNAPSHOT_FAULTS)
def test_a_header_with_one_fault_is_refused_by_that_fault(fault: str) -> None:
    edit, reason = SNAPSHOT_FAULTS[fault]
    _, content, body = unwire(SAMPLES["snapshot"])
    edit(content)
    with pytest.raises(ProtocolError, match=reason):
        decode(wire(content, body), LIMITS)


@pytest.mark.parametrize("sides", [[0] + [1 << 26] * 3, [1 << 26] * 3 + [0], [1 << 26] * 7 + [0]])
def test_an_empty_array_with_huge_sides_is_refused_or_empty(sides: list[int]) -> None:
    _, content, _ = unwire(SAMPLES["snapshot"])
    content.update(arrays=[["weights/w", "<f4", sides]], size=0)
    decoded_or_refused(wire(content))


@pytest.mark.parametrize("message", [Join(actor="a", incarnation=1), WELCOME, SNAPSHOT, some_rollout()])
def test_every_field_is_needed_and_no_other_is_known(message: Message) -> None:
    flags, content, body = unwire(encode(message))
    for name in content["fields"]:
        less = copy.deepcopy(content)
        del less["fields"][name]
        with pytest.raises(ProtocolError, match=f"field '{name}' is missing"):
            decode(wire(less, body, flags=flags), LIMITS)
    content["fields"]["typo"] = None
    with pytest.raises(ProtocolError, match="unknown field 'typo'"):
        decode(wire(content, body, flags=flags), LIMITS)


def test_faults_within_a_nested_message_are_named_by_their_path() -> None:
    flags, content, body = unwire(SAMPLES["rollout"])
    for identity, reason in (
        (1, "'identity' must be a map"),
        ({**content["fields"]["identity"], "sequence": True}, "'identity.sequence' must be int, not bool"),
        ({**content["fields"]["identity"], "x": 1}, "unknown field 'identity.x'"),
        ({"actor": "a"}, "field 'identity.incarnation' is missing"),
    ):
        content["fields"]["identity"] = identity
        with pytest.raises(ProtocolError, match=reason):
            decode(wire(content, body, flags=flags), LIMITS)


def test_every_array_of_a_rollout_is_needed() -> None:
    rollout = some_rollout()
    for name in ("observations", "actions", "valid", "episode_lengths"):
        flags, content, body = unwire(encode(rollout))
        for entry in content["arrays"]:
            entry[0] = f"not_{name}" if entry[0] == name else entry[0]
        with pytest.raises(ProtocolError, match=f"array '{name}' is missing"):
            decode(wire(content, body, flags=flags), LIMITS)


def test_an_array_beyond_the_expected_is_refused() -> None:
    _, content, _ = unwire(encode(Farewell(learner_epoch=1, reason="")))
    content.update(arrays=[["extra", "|u1", [8]]], size=8)
    with pytest.raises(ProtocolError, match="Farewell has no array 'extra'"):
        decode(wire(content, bytes(8)), LIMITS)


def test_shapes_that_do_not_fit_together_are_refused_by_the_messages_own_check() -> None:
    flags, content, body = unwire(SAMPLES["rollout"])
    content["arrays"][1][2] = [4, 8]
    with pytest.raises(ProtocolError, match="Rollout: observations must be"):
        decode(wire(content, body, flags=flags), LIMITS)


@pytest.mark.parametrize("code", ["other", "", 1, None, ["mismatch"]])
def test_a_choice_outside_its_list_is_refused(code: Any) -> None:
    _, content, _ = unwire(encode(Refusal(code="mismatch", reason="")))
    content["fields"]["code"] = code
    with pytest.raises(ProtocolError, match="'code' must be one of mismatch"):
        decode(wire(content), LIMITS)


@pytest.mark.parametrize("spec", [None, 1, [], {}, {"environment": {"id": "x"}, "typo": 1}])
def test_a_specification_that_does_not_hold_is_refused(spec: Any) -> None:
    _, content, _ = unwire(encode(WELCOME))
    content["fields"]["spec"] = spec
    with pytest.raises(ProtocolError, match="Welcome: "):
        decode(wire(content), LIMITS)


@pytest.mark.parametrize("value", [2, 255])
def test_a_truth_value_is_0_or_1(value: int) -> None:
    _, content, _ = unwire(SAMPLES["snapshot"])
    content.update(arrays=[["weights/w", "|b1", [8]]], size=8)
    decode(wire(content, bytes([0, 1] * 4)), LIMITS)
    with pytest.raises(ProtocolError, match="'weights/w' has a truth value that is neither 0 nor 1"):
        decode(wire(content, bytes([0, 1, 0, 1, 0, 1, 0, value])), LIMITS)


def test_the_header_must_be_a_map() -> None:
    for content in (None, 1, "x", [], {}):
        with pytest.raises(ProtocolError, match="exactly kind, fields, arrays and size"):
            decode(wire(content), LIMITS)


def test_unknown_flags_and_magic_are_refused() -> None:
    _, content, body = unwire(SAMPLES["snapshot"])
    with pytest.raises(ProtocolError, match="unknown flags 2"):
        decode(wire(content, body, flags=2), LIMITS)
    with pytest.raises(ProtocolError, match="not a message of this protocol"):
        decode(b"HTTP" + SAMPLES["snapshot"][4:], LIMITS)


@pytest.mark.parametrize("version", [0, 2, 65_535])
def test_another_version_is_named_beside_our_own(version: int) -> None:
    for data in (wire({}, version=version), wire_header(b"\xc1 of the future", version=version)):
        with pytest.raises(VersionMismatchError, match=rf"version {version}, this one {PROTOCOL_VERSION}:") as refused:
            decode(data, LIMITS)
        assert refused.value.theirs == version


# --------------------------------------------------------------------------------- what it may cost


def peak_bytes(data: bytes, limits: Limits) -> int:
    """The most memory that refusing `data` took."""
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError):
            decode(data, limits)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def zeros_frame(size: int, *, declared: bool) -> bytes:
    """A zstd frame of `size` zeros, made without ever holding them."""
    compressor = zstandard.ZstdCompressor().compressobj(size=size if declared else -1)
    chunk = bytes(1 << 20)
    return b"".join(compressor.compress(chunk) for _ in range(size >> 20)) + compressor.flush()


BOMB = 256 << 20
SMALL = Limits(max_bytes=1 << 20, max_header_bytes=4096, max_arrays=4)


def bomb(frame: bytes, size: int) -> bytes:
    _, content, _ = unwire(SAMPLES["snapshot"])
    content.update(arrays=[["weights/w", "|u1", [size]]], size=size)
    return wire(content, frame, flags=1)


def test_a_frame_that_declares_more_than_the_header_is_not_unpacked() -> None:
    frame = zeros_frame(BOMB, declared=True)
    assert len(frame) < 1 << 20
    assert peak_bytes(bomb(frame, 1 << 16), SMALL) < 2 << 20
    assert peak_bytes(bomb(frame, BOMB), SMALL) < 2 << 20


def test_a_frame_that_declares_nothing_is_not_unpacked() -> None:
    assert peak_bytes(bomb(zeros_frame(BOMB, declared=False), 1 << 16), SMALL) < 2 << 20


def test_a_frame_that_lies_about_its_size_is_unpacked_no_further() -> None:
    frame = zeros_frame(BOMB, declared=True)
    lie = frame.replace(struct.pack("<I", BOMB), struct.pack("<I", 1 << 16), 1)
    assert lie != frame
    assert zstandard.frame_content_size(lie) == 1 << 16
    assert peak_bytes(bomb(lie, 1 << 16), SMALL) < 2 << 20


def test_a_frame_that_holds_less_than_it_declares_is_refused() -> None:
    frame = zstandard.ZstdCompressor().compress(bytes(1 << 16))
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
        b"\xc4\x04abcd",  # bytes at all
        b"\xd6\x01abcd",  # an extension at all
        b"\xd6\xffabcd",  # a timestamp
        b"\xa2\xff\xff",  # text that is not UTF-8
        b"\xc1",  # never used
        b"\x91" * 4000,  # deep
        b"\x81\xa1a" * 1300,  # deep
        b"\x81\x90\x01",  # a list for a key
        b"\x81\x01\x01",  # a number for a key
        b"\x80\x80",  # two values
    ],
)
def test_a_header_that_declares_the_moon_costs_nothing(header: bytes) -> None:
    assert peak_bytes(wire_header(header), SMALL) < 1 << 20


@pytest.mark.parametrize("depth", [100, 254, 255, 400, 500, 511, 512, 2000])
def test_deep_nesting_is_decoded_or_refused(depth: int) -> None:
    _, content, _ = unwire(encode(WELCOME))
    for opening, closing in ((b"\x91", b""), (b"\x81\xa1a", b"")):
        nested = opening * depth + b"\x01" + closing
        content["fields"]["spec"]["environment"]["kwargs"] = {"a": "HERE"}
        header = (msgpack.packb(content) or b"").replace(b"\xa4HERE", nested)
        decoded_or_refused(wire_header(header))


def test_a_header_beyond_its_limit_is_not_read() -> None:
    _, content, _ = unwire(encode(Farewell(learner_epoch=1, reason="x" * 5000)))
    with pytest.raises(ProtocolError, match="the header declares .* the limit is 4096"):
        decode(wire(content), SMALL)
    with pytest.raises(ProtocolError, match="the header declares 4294967295 bytes"):
        decode(PREFIX.pack(b"DAED", PROTOCOL_VERSION, 0, 2**32 - 1), SMALL)


def test_more_arrays_than_the_limit_are_refused() -> None:
    many = {f"w{index}": np.zeros(1, np.float32) for index in range(5)}
    data = encode(dataclasses.replace(SNAPSHOT, weights=many))
    decode(data, LIMITS)
    with pytest.raises(ProtocolError, match="5 arrays, the limit is 4"):
        decode(data, SMALL)


def test_a_body_at_the_limit_is_accepted_and_one_beyond_it_refused() -> None:
    limits = Limits(max_bytes=4096)
    for count, kind in ((1024, Snapshot), (1026, None)):
        data = encode(dataclasses.replace(SNAPSHOT, weights={"w": np.zeros(count, np.float32)}))
        if kind is None:
            with pytest.raises(ProtocolError, match="the limit is 4096"):
                decode(data, limits)
        else:
            assert isinstance(decode(data, limits), kind)
    with pytest.raises(ProtocolError, match="a message of .* bytes, the limit is 4096"):
        decode(SAMPLES["snapshot"] + bytes(5000), limits)
