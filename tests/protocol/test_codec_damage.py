"""Arbitrary bytes give a message or a ProtocolError, and each fault in a header is named."""

import contextlib
import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_strategies import messages, text
from wire_format import (
    DTYPES,
    LIMITS,
    SAMPLES,
    SNAPSHOT,
    WELCOME,
    decoded_or_refused,
    repeatable,
    some_rollout,
    unwire,
    wire,
    wire_header,
)

from daedalus.protocol.codec import PROTOCOL_VERSION, ProtocolError, VersionMismatchError, decode, encode
from daedalus.protocol.limits import JOIN_LIMITS, Limits
from daedalus.protocol.messages import Join, Message, Refusal, RunEnded, Snapshot


@pytest.mark.parametrize("name", SAMPLES)
def test_truncated_message_is_rejected(name: str) -> None:
    data = SAMPLES[name]
    decode(data, LIMITS)
    for length in range(len(data)):
        with pytest.raises(ProtocolError):
            decode(data[:length], LIMITS)


@pytest.mark.parametrize("name", SAMPLES)
def test_message_with_trailing_bytes_is_rejected(name: str) -> None:
    for extra in (b"\0", b"\0" * 8, SAMPLES[name]):
        if name in ("join", "status"):  # without a body: trailing bytes would be a body
            extra = extra.rjust(16, b"\0")
        with pytest.raises(ProtocolError):
            decode(SAMPLES[name] + extra, LIMITS)


@pytest.mark.parametrize("name", SAMPLES)
def test_flipped_bit_raises_only_protocol_errors(name: str) -> None:
    for position in range(len(SAMPLES[name])):
        for bit in range(8):
            data = bytearray(SAMPLES[name])
            data[position] ^= 1 << bit
            decoded_or_refused(bytes(data))


@repeatable
@given(header=st.binary(max_size=100), body=st.binary(max_size=64), flags=st.integers(0, 2))
def test_random_bytes_and_headers_are_rejected(header: bytes, body: bytes, flags: int) -> None:
    for data in (header + body, wire_header(header, body, flags=flags)):
        with pytest.raises(ProtocolError):
            decode(data, LIMITS)


@settings(repeatable, max_examples=300)
@given(
    message=messages,
    edits=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 3), st.binary(max_size=8)), min_size=1, max_size=5),
)
def test_edited_messages_are_decoded_or_rejected(message: Message, edits: list[tuple[int, int, bytes]]) -> None:
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
def test_header_with_replaced_values_is_decoded_or_rejected(message: Message, choices: list[int], value: Any) -> None:
    flags, content, body = unwire(encode(message))
    node, key = content, "fields"
    for choice in choices:  # descends to an entry of the header and replaces it
        entries = list(node) if isinstance(node, dict) else list(range(len(node)))
        key: Any = entries[choice % len(entries)]
        if choice > 24 or not isinstance(node[key], dict | list) or not node[key]:
            break
        node = node[key]
    else:
        return
    node[key] = value
    decoded_or_refused(wire(content, body, flags=flags))


Edit = Callable[[dict[str, Any]], object]
SNAPSHOT_FAULTS: dict[str, tuple[Edit, str]] = {
    "unknown kind": (lambda c: c.update(kind="Pickle"), "unknown kind"),
    "kind of another type": (lambda c: c.update(kind=["Snapshot"]), "unknown kind"),
    "field missing": (lambda c: c["fields"].pop("program"), "field 'program' is missing"),
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
    "array twice": (lambda c: c["arrays"][1].__setitem__(0, "weights/w"), "distinct"),
    "array name a number": (lambda c: c["arrays"][0].__setitem__(0, 1), "distinct strings"),
    "array without a shape": (lambda c: c["arrays"][0].pop(2), "a name, a dtype, a shape and whether"),
    "array a map": (lambda c: c["arrays"].__setitem__(0, {}), "a name, a dtype, a shape and whether"),
    "array of version 1": (lambda c: c["arrays"][0].pop(), "a name, a dtype, a shape and whether it is swapped"),
    "array with more": (lambda c: c["arrays"][0].append(False), "a name, a dtype, a shape and whether"),
    "swapped a number": (lambda c: c["arrays"][0].__setitem__(3, 1), "'weights/w' has an invalid swapped flag"),
    "swapped text": (lambda c: c["arrays"][0].__setitem__(3, "true"), "has an invalid swapped flag"),
    "swapped nil": (lambda c: c["arrays"][0].__setitem__(3, None), "has an invalid swapped flag"),
    "swapped without a second axis": (
        lambda c: c["arrays"][1].__setitem__(3, True),
        "'weights/b' has an invalid swapped flag",
    ),
    "swapped scalar": (lambda c: c["arrays"].__setitem__(1, ["b", "<f4", [], True]), "'b' has an invalid swapped flag"),
    "dtype float16": (lambda c: c["arrays"][0].__setitem__(1, "<f2"), "has an unsupported dtype"),
    "dtype object": (lambda c: c["arrays"][0].__setitem__(1, "|O"), "has an unsupported dtype"),
    "dtype big-endian": (lambda c: c["arrays"][0].__setitem__(1, ">f4"), "has an unsupported dtype"),
    "dtype a list": (lambda c: c["arrays"][0].__setitem__(1, ["<f4"]), "has an unsupported dtype"),
    "shape a number": (lambda c: c["arrays"][0].__setitem__(2, 4), "an invalid shape"),
    "side negative": (lambda c: c["arrays"][0].__setitem__(2, [-2, -2]), "an invalid shape"),
    "side -1": (lambda c: c["arrays"][0].__setitem__(2, [2, -1]), "an invalid shape"),
    "side a float": (lambda c: c["arrays"][0].__setitem__(2, [2.0, 2]), "an invalid shape"),
    "side NaN": (lambda c: c["arrays"][0].__setitem__(2, [float("nan"), 2]), "an invalid shape"),
    "side a bool": (lambda c: c["arrays"][0].__setitem__(2, [True, 4]), "an invalid shape"),
    "side too long": (lambda c: c["arrays"][0].__setitem__(2, [2**40, 2]), "an invalid shape"),
    "too many dimensions": (lambda c: c["arrays"][0].__setitem__(2, [1] * 9), "an invalid shape"),
    "shape larger than the body": (lambda c: c["arrays"][0].__setitem__(2, [2, 200]), "the body declares 24"),
    "product of sides huge": (lambda c: c["arrays"][0].__setitem__(2, [1 << 26] * 8), "the body declares 24"),
    "size less than the arrays": (lambda c: c.update(size=16), "the body declares 16"),
    "size more than the arrays": (lambda c: c.update(size=32), "the arrays take 24 bytes, the body declares 32"),
    "size beyond the limit": (lambda c: c.update(size=LIMITS.max_bytes + 8), "the limit is"),
    "size of 64 bits": (lambda c: c.update(size=2**64 - 1), "the limit is"),
}


def test_reason_is_short_and_printable_whatever_the_sender_wrote() -> None:
    _, content, body = unwire(SAMPLES["snapshot"])
    content["arrays"][0][:2] = ["\n\x1b" + "x" * 100_000, "<f2"]
    with pytest.raises(ProtocolError, match=r"^array '\\n\\x1bxxx") as caught:
        decode(wire(content, body), LIMITS)
    assert len(str(caught.value).encode()) == 300


@pytest.mark.parametrize("fault", SNAPSHOT_FAULTS)
def test_faulty_header_is_rejected_with_the_fault(fault: str) -> None:
    edit, reason = SNAPSHOT_FAULTS[fault]
    _, content, body = unwire(SAMPLES["snapshot"])
    edit(content)
    with pytest.raises(ProtocolError, match=reason):
        decode(wire(content, body), LIMITS)


@pytest.mark.parametrize("sides", [[0] + [1 << 26] * 3, [1 << 26] * 3 + [0], [1 << 26] * 7 + [0]])
def test_empty_array_with_huge_sides_is_rejected_or_empty(sides: list[int]) -> None:
    _, content, _ = unwire(SAMPLES["snapshot"])
    for swapped in (False, True):
        content.update(arrays=[["weights/w", "<f4", sides, swapped]], size=0)
        with contextlib.suppress(ProtocolError):
            snapshot = decode(wire(content), LIMITS)
            assert isinstance(snapshot, Snapshot)
            assert snapshot.weights["w"].size == 0


@pytest.mark.parametrize("message", [Join(actor="a", incarnation=1), WELCOME, SNAPSHOT, some_rollout()])
def test_missing_field_has_its_default_and_is_rejected_without_one(message: Message) -> None:
    flags, content, body = unwire(encode(message))
    defaults = {field.name: field.default for field in dataclasses.fields(message)}
    for name in content["fields"]:
        less = copy.deepcopy(content)
        del less["fields"][name]
        data = wire(less, body, flags=flags)
        if defaults[name] is dataclasses.MISSING:
            with pytest.raises(ProtocolError, match=f"field '{name}' is missing"):
                decode(data, LIMITS)
        else:
            assert getattr(decode(data, LIMITS), name) == defaults[name]


def test_faults_in_a_nested_message_are_named_by_path() -> None:
    flags, content, body = unwire(SAMPLES["rollout"])
    for identity, reason in (
        (1, "'identity' must be a map"),
        ({**content["fields"]["identity"], "sequence": True}, "'identity.sequence' must be int, not bool"),
        ({"actor": "a"}, "field 'identity.incarnation' is missing"),
    ):
        content["fields"]["identity"] = identity
        with pytest.raises(ProtocolError, match=reason):
            decode(wire(content, body, flags=flags), LIMITS)


def test_missing_array_of_a_rollout_is_rejected() -> None:
    rollout = some_rollout()
    for name in ("initial_state", "behaviour_log_probs", "valid", "episode_lengths"):
        flags, content, body = unwire(encode(rollout))
        for entry in content["arrays"]:
            entry[0] = f"not_{name}" if entry[0] == name else entry[0]
        with pytest.raises(ProtocolError, match=f"array '{name}' is missing"):
            decode(wire(content, body, flags=flags), LIMITS)


def test_unknown_array_counts_against_the_limits() -> None:
    _, content, _ = unwire(encode(RunEnded(learner_epoch=1, outcome="finished", reason="")))
    content.update(arrays=[["extra", "|u1", [8], False]], size=8)
    assert isinstance(decode(wire(content, bytes(8)), LIMITS), RunEnded)
    for limits, reason in (
        (JOIN_LIMITS, "bytes, the limit is 0"),
        (Limits(max_arrays=0), "1 arrays, the limit is 0"),
    ):
        with pytest.raises(ProtocolError, match=reason):
            decode(wire(content, bytes(8)), limits)


def test_inconsistent_shapes_are_rejected_by_the_message_class() -> None:
    flags, content, body = unwire(SAMPLES["rollout"])
    assert content["arrays"][2][0] == "actions/action"
    content["arrays"][2][2] = [4, 8, 1]
    with pytest.raises(ProtocolError, match="Rollout: actions/action must be"):
        decode(wire(content, body, flags=flags), LIMITS)


@pytest.mark.parametrize("code", ["other", "", 1, None, ["mismatch"]])
def test_unknown_choice_is_rejected(code: Any) -> None:
    _, content, _ = unwire(encode(Refusal(code="mismatch", reason="")))
    content["fields"]["code"] = code
    with pytest.raises(ProtocolError, match="'code' must be one of mismatch"):
        decode(wire(content), LIMITS)


@pytest.mark.parametrize("spec", [None, 1, [], {}, {"environment": {"id": 1}}, {"environment": {"id": "x", "grey": 9}}])
def test_invalid_specification_is_rejected(spec: Any) -> None:
    _, content, _ = unwire(encode(WELCOME))
    content["fields"]["spec"] = spec
    with pytest.raises(ProtocolError, match="Welcome: "):
        decode(wire(content), LIMITS)


@pytest.mark.parametrize("value", [2, 255])
def test_bool_that_is_neither_0_nor_1_is_rejected(value: int) -> None:
    _, content, _ = unwire(SAMPLES["snapshot"])
    content.update(arrays=[["weights/w", "|b1", [8], False]], size=8)
    decode(wire(content, bytes([0, 1] * 4)), LIMITS)
    with pytest.raises(ProtocolError, match="'weights/w' has a bool that is neither 0 nor 1"):
        decode(wire(content, bytes([0, 1, 0, 1, 0, 1, 0, value])), LIMITS)


def test_the_header_must_be_a_map() -> None:
    for content in (None, 1, "x", [], {}):
        with pytest.raises(ProtocolError, match="exactly kind, fields, arrays and size"):
            decode(wire(content), LIMITS)


def test_unknown_flags_and_magic_are_rejected() -> None:
    _, content, body = unwire(SAMPLES["snapshot"])
    with pytest.raises(ProtocolError, match="unknown flags 2"):
        decode(wire(content, body, flags=2), LIMITS)
    with pytest.raises(ProtocolError, match="not a message of this protocol"):
        decode(b"HTTP" + SAMPLES["snapshot"][4:], LIMITS)


@pytest.mark.parametrize("version", [0, PROTOCOL_VERSION - 1, PROTOCOL_VERSION + 1, 65_535])
def test_error_names_both_protocol_versions(version: int) -> None:
    for data in (wire({}, version=version), wire_header(b"\xc1 of the future", version=version)):
        with pytest.raises(VersionMismatchError, match=rf"version {version}, this one {PROTOCOL_VERSION}:") as refused:
            decode(data, LIMITS)
        assert refused.value.theirs == version


@pytest.mark.parametrize("value", [b"bytes", msgpack.ExtType(5, b"x"), {1: "an integer as key"}])
def test_a_header_has_only_texts_as_keys_and_no_bytes_or_extensions(value: Any) -> None:
    data = wire({"kind": "Join", "fields": {"origin": value}, "arrays": [], "size": 0})
    with pytest.raises(ProtocolError, match="unreadable header: ValueError"):
        decode(data, LIMITS)
