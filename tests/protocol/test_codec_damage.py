"""Decoding arbitrary bytes gives a message or a ProtocolError."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_strategies import messages, text
from wire_format import DTYPES, LIMITS, SAMPLES, decoded_or_refused, repeatable, unwire, wire, wire_header

from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.messages import Message


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
