"""The stored bytes of every message: they make each change of the wire format visible."""

import json
import typing
from typing import Any

import golden_values
import pytest
import zstandard
from golden import MESSAGES, path
from wire_format import PREFIX, the_same, unwire, wire

from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Message


def plain(data: bytes) -> bytes:
    """Return a message with its body decompressed: the output of zstd may differ between releases."""
    magic, version, flags, length = PREFIX.unpack_from(data)
    start = PREFIX.size + length
    start += -start % 8
    body = zstandard.ZstdDecompressor().decompress(data[start:]) if flags else data[start:]
    return PREFIX.pack(magic, version, flags, length) + data[PREFIX.size : start] + body


def test_every_kind_of_message_has_golden_bytes() -> None:
    assert {type(message) for message in MESSAGES.values()} == set(typing.get_args(Message))


def old_part(written: Any, golden: Any) -> Any:
    """Return what is written without the fields that the golden map does not have: later releases write more."""
    if not isinstance(written, dict) or not isinstance(golden, dict):
        return written
    return {name: old_part(value, golden[name]) for name, value in written.items() if name in golden}


@pytest.mark.parametrize("name", MESSAGES)
def test_bytes_match_the_golden_bytes(name: str) -> None:
    stored = path(name).read_bytes()
    assert the_same(decode(stored, Limits()), MESSAGES[name])
    golden = plain(stored)
    flags, content, body = unwire(plain(encode(MESSAGES[name])))
    content["fields"] = old_part(content["fields"], unwire(golden)[1]["fields"])
    assert wire(content, body, flags=flags) == golden


def test_contents_of_the_golden_messages_are_stored_as_json() -> None:
    golden = json.loads(golden_values.PATH.read_text())
    assert golden == old_part(json.loads(json.dumps(golden_values.values())), golden)
