"""The stored bytes of every message: they make each change of the wire format visible."""

import json
import typing

import golden_values
import pytest
import zstandard
from golden import MESSAGES, path
from wire_format import PREFIX, the_same

from daedalus.protocol.codec import PROTOCOL_VERSION, VersionMismatchError, decode, encode
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


@pytest.mark.parametrize("name", MESSAGES)
def test_bytes_match_the_golden_bytes(name: str) -> None:
    written = path(name).read_bytes()
    assert plain(encode(MESSAGES[name])) == plain(written)
    assert the_same(decode(written, Limits()), MESSAGES[name])


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.parametrize("version", [PROTOCOL_VERSION - 1, PROTOCOL_VERSION + 1])
def test_bytes_of_other_versions_are_rejected_with_their_version(name: str, version: int) -> None:
    written = path(name).read_bytes()
    other = written[:4] + version.to_bytes(2, "little") + written[6:]
    with pytest.raises(VersionMismatchError, match=f"version {version}, this one {PROTOCOL_VERSION}"):
        decode(other, Limits())


def test_contents_of_the_golden_messages_are_stored_as_json() -> None:
    assert json.loads(golden_values.PATH.read_text()) == json.loads(json.dumps(golden_values.values()))
