"""Encoding messages as bytes, and decoding bytes that may be damaged or hostile.

    offset  bytes
         0      4  magic b"DAED"
         4      2  lowest protocol version whose readers can read the message, little-endian
         6      2  0: the body is plain, 1: the body is one zstd frame
         8      4  length of the header, little-endian
        12      -  header: one msgpack map {"kind", "fields", "arrays", "size"}, padded with zeros to 8; each
                   array is [name, dtype, shape, swapped]
         -      -  body: the raw little-endian buffers of the arrays, each padded with zeros to 8; of a
                   swapped one the buffer's second axis comes first

A rollout's frames are swapped: in the order of environments, each frame follows its predecessor, and zstd finds it.

The first six bytes keep their meaning in every version, so that an end can name the version of the other. Decoding
executes nothing, and checks every declared size against `Limits` before it allocates memory. This file knows no keys
and no transport.
"""

import dataclasses
import functools
import math
import struct
import threading
import types
import typing
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import msgpack
import numpy as np
import zstandard
from pydantic import BaseModel, ValidationError

from daedalus.protocol.limits import LEARNER_LIMITS, Limits
from daedalus.protocol.messages import CompactSnapshot, Message, Origin, Program
from daedalus.protocol.releases import as_release, misfit
from daedalus.protocol.texts import bounded_text
from daedalus.protocol.uploads import Gradient, Rollout


def pack(value: Any, path: str, arrays: list[tuple[str, np.ndarray]]) -> dict[str, Any]:
    """Return the fields of a message as a plain map, and append its arrays to `arrays`, named `path` + field."""
    packed: dict[str, Any] = {}
    for name, kind, _, _, sparse in _fields(type(value)):
        item = getattr(value, name)
        if kind == _ARRAYS:
            arrays.extend((f"{path}{name}/{key}", array) for key, array in item.items())
        elif kind == _ARRAY or (kind == _OPTIONAL_ARRAY and item is not None):
            arrays.append((path + name, item))
        elif kind == _MESSAGE:
            packed[name] = pack(item, f"{path}{name}.", arrays)
        elif isinstance(item, BaseModel):
            packed[name] = item.model_dump(mode="json")
        elif kind == _VALUE and (item is not None or not sparse):
            packed[name] = item
    return packed


_Arrays = dict[str, np.ndarray | dict[str, np.ndarray]]  # by field: its array, or its map of arrays


def unpack(cls: type, fields: dict[str, Any], path: str, arrays: _Arrays) -> Any:
    """Build a message of class `cls` from a map made by `pack`, and from arrays.

    A missing field has its default. Fields that the class does not have are ignored: a newer release wrote them.
    Raises ValueError, which names the field, for one that is missing without a default, or of the wrong type.
    """
    values: dict[str, Any] = {}
    for name, kind, read, optional, _ in _fields(cls):
        if kind == _ARRAYS:
            values[name] = arrays.get(path + name, {})
        elif kind in (_ARRAY, _OPTIONAL_ARRAY):
            values[name] = arrays.get(path + name)
            if values[name] is None and kind == _ARRAY:
                raise ValueError(f"array {path + name!r} is missing")
        elif name in fields:
            values[name] = read(fields[name], path + name)
        elif not optional:
            raise ValueError(f"field {path + name!r} is missing")
    return cls(**values)


_ARRAY, _OPTIONAL_ARRAY, _ARRAYS, _MESSAGE, _VALUE = range(5)  # kinds of fields


class _Field(NamedTuple):
    """One field of a class of messages, read from its annotation once: annotations are slow to tell apart."""

    name: str
    kind: int
    read: Callable[[Any, str], Any]  # returns the value of a field from what arrived and the field's name, or raises
    optional: bool  # whether it has a default
    sparse: bool  # whether it is not sent while it is None: few messages have it


@functools.cache
def _fields(cls: type) -> tuple[_Field, ...]:
    hints, missing = typing.get_type_hints(cls), dataclasses.MISSING
    return tuple(
        _Field(
            field.name,
            _kind(hints[field.name]),
            _reader(hints[field.name]),
            field.default is not missing or field.default_factory is not missing,
            bool(field.metadata.get("sparse")),
        )
        for field in dataclasses.fields(cls)
    )


def _kind(annotation: Any) -> int:
    if annotation is np.ndarray:
        return _ARRAY
    if annotation == np.ndarray | None:
        return _OPTIONAL_ARRAY
    if typing.get_origin(annotation) is dict and typing.get_args(annotation)[1] is np.ndarray:
        return _ARRAYS
    return _MESSAGE if dataclasses.is_dataclass(annotation) else _VALUE


@functools.cache
def _array_fields(cls: type) -> dict[str, bool]:
    """Return the names of the fields of arrays, and whether each is a map of them."""
    kinds = (_ARRAY, _OPTIONAL_ARRAY, _ARRAYS)
    return {field.name: field.kind == _ARRAYS for field in _fields(cls) if field.kind in kinds}


def _reader(annotation: Any) -> Callable[[Any, str], Any]:
    """Return the function that reads a field which is no array."""
    if isinstance(annotation, types.UnionType):  # `X | None`
        read_present = _reader(typing.get_args(annotation)[0])
        return lambda item, path: None if item is None else read_present(item, path)
    if dataclasses.is_dataclass(annotation):
        return functools.partial(_read_message, annotation)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return lambda item, _: annotation.model_validate(item, extra="ignore")
    if typing.get_origin(annotation) is typing.Literal:
        return functools.partial(_read_literal, typing.get_args(annotation))
    return functools.partial(_read_plain, annotation)


def _read_message(cls: Any, item: Any, path: str) -> Any:
    if not isinstance(item, dict):
        raise ValueError(f"field {path!r} must be a map")
    return unpack(cls, item, path + ".", {})


def _read_literal(choices: tuple[Any, ...], item: Any, path: str) -> Any:
    if not isinstance(item, str) or item not in choices:
        raise ValueError(f"field {path!r} must be one of {', '.join(choices)}")
    return item


def _read_plain(annotation: Any, item: Any, path: str) -> Any:
    if type(item) is not annotation:
        raise ValueError(f"field {path!r} must be {annotation.__name__}, not {type(item).__name__}")
    if annotation is int and not 0 <= item < 2**63:
        raise ValueError(f"field {path!r} must be from 0 to 2^63 - 1")
    return item


PROTOCOL_VERSION = 11  # that this release reads, besides all from FIRST_VERSION on; docs/wire.md says when to raise it
FIRST_VERSION = 11  # of messages whose readers ignore what they do not know

_MAGIC = b"DAED"
_PREFIX = struct.Struct("<4sHHI")
_PLAIN, _ZSTD = 0, 1
_ALIGNMENT = 8
_DTYPES = {name: np.dtype(name) for name in ("<f4", "|u1", "|b1", "<u2", "<i4", "<i8", "<f8")}
_KINDS: dict[str, type] = {cls.__name__: cls for cls in typing.get_args(Message)}
_COMPRESSED = (Rollout, Gradient, Program, CompactSnapshot)  # zstd cannot compress weights; other messages are small
_LEVEL = -1  # of zstd for floats: the faster one, which would leave pixels and byte planes twice as large
_BYTES_LEVEL = 1  # for these
_MAX_DIMENSIONS = 8
_MAX_DESCRIBED = 100  # faults of a model; pydantic describes all or none, and a hostile header has 60,000


class ProtocolError(Exception):
    """The bytes are not an acceptable message: a fault of the sender. The reason may quote it, so it is bounded."""

    def __init__(self, reason: str) -> None:
        super().__init__(bounded_text(reason))


class VersionMismatchError(ProtocolError):
    """The message needs another version of the protocol."""

    def __init__(self, theirs: int, release: str = "") -> None:
        """`theirs` is the version, and `release` what the sender states as its release, or empty."""
        super().__init__(misfit(release, theirs, PROTOCOL_VERSION))
        self.theirs = theirs


class UnfitMessageError(ProtocolError):
    """The message has this form, but a value of it does not fit this release."""

    def __init__(self, kind: str, reason: str, release: str = "") -> None:
        """`release` is what the sender states as its release, or empty."""
        super().__init__(f"{kind}: {reason}")
        self.kind, self.release = kind, release


def encode(message: Message) -> bytes:
    """Encode a message.

    Its version is FIRST_VERSION, or its `lowest_version` if its class has that property.

    Raises ValueError for an array whose dtype the protocol does not support, and for a header that no reader accepts:
    faults of the caller.
    """
    arrays: list[tuple[str, np.ndarray]] = []
    content = {"kind": type(message).__name__, "fields": pack(message, "", arrays), "arrays": []}
    parts: list[bytes | memoryview] = []
    for name, array in arrays:
        dtype, swapped = _wire_dtype(name, array.dtype), _is_swapped(array)
        content["arrays"].append((name, dtype.str, array.shape, swapped))
        parts.append(np.ascontiguousarray(array.swapaxes(0, 1) if swapped else array, dtype).data)
        parts.append(bytes(-array.nbytes % _ALIGNMENT))
    body = b"".join(parts)
    content["size"] = len(body)
    header = cast(bytes, msgpack.packb(content))
    if len(header) > LEARNER_LIMITS.max_header_bytes:
        raise ValueError(
            f"the header of a {type(message).__name__} has {len(header):,} bytes, "
            f"readers accept {LEARNER_LIMITS.max_header_bytes:,}"
        )
    flags = _PLAIN
    if isinstance(message, _COMPRESSED) and body:
        in_bytes = isinstance(message, (CompactSnapshot, Gradient)) or any(
            array.dtype == np.uint8 and array.ndim > 3 for _, array in arrays
        )
        smaller = (_zstd.bytes_compressor if in_bytes else _zstd.compressor).compress(body)
        if len(smaller) < len(body):
            flags, body = _ZSTD, smaller
    padding = bytes(-(_PREFIX.size + len(header)) % _ALIGNMENT)
    version = getattr(message, "lowest_version", FIRST_VERSION)
    return b"".join((_PREFIX.pack(_MAGIC, version, flags, len(header)), header, padding, body))


def decode(data: bytes, limits: Limits) -> Message:
    """Decode a message; its arrays are read-only. Fields and arrays that its class does not have are ignored.

    Raises VersionMismatchError if this release cannot read its version, and ProtocolError if the bytes are not exactly
    one complete and consistent message within `limits`. No input raises any other exception.
    """
    try:
        flags, header, body = _split(data, limits)
    except VersionMismatchError as error:
        raise VersionMismatchError(error.theirs, _release_in(_fields_of(data, limits))) from None
    kind, fields, arrays, size = _read_header(header)
    if size > limits.max_bytes:
        raise ProtocolError(f"the body declares {size} bytes, the limit is {limits.max_bytes}")
    if flags == _ZSTD and _KINDS[kind] not in _COMPRESSED:
        raise ProtocolError(f"a {kind} must not be compressed")
    layout = _read_layout(arrays, size, limits)
    known = _array_fields(_KINDS[kind])
    layout = [entry for entry in layout if known.get(entry.name.partition("/")[0]) == ("/" in entry.name)]
    buffers = _read_arrays(layout, _plain_body(flags, body, size))
    try:
        message = unpack(_KINDS[kind], fields, "", buffers)
    except ValidationError as error:
        raise UnfitMessageError(kind, _first_fault(error), _release_in(fields)) from None
    except ValueError as error:
        raise UnfitMessageError(kind, str(error), _release_in(fields)) from None
    return message


def origin_of(data: bytes, limits: Limits) -> Origin:
    """Return the origin in a Join of any protocol version, as far as it can be read; its texts may be empty.

    A learner names the host whose version it refuses. Versions before 6 have no origin.
    """
    try:
        return unpack(Origin, dict(_fields_of(data, limits)["origin"]), "", {})
    except (KeyError, TypeError, ValueError):
        return Origin()


def _fields_of(data: bytes, limits: Limits) -> dict[str, Any]:
    """Return the fields of a message of any protocol version, unchecked; none if they cannot be read."""
    try:
        _, header, _ = _split(data, limits, any_version=True)
        return _read_header(header)[1]
    except ProtocolError:
        return {}


def _release_in(fields: dict[str, Any]) -> str:
    """Return the release that the sender of a message states, or an empty text."""
    for stated in (fields, fields.get("origin"), fields.get("status")):
        if isinstance(stated, dict) and (release := as_release(stated.get("software"))):
            return release
    return ""


# ------------------------------------------------------------------------------------------- writing


def _wire_dtype(name: str, dtype: np.dtype) -> np.dtype:
    found = _DTYPES.get(dtype.str) or _DTYPES.get(dtype.newbyteorder("<").str)
    if found is None:
        raise ValueError(f"array {name!r} has dtype {dtype}, which the protocol does not support")
    return found


def _is_swapped(array: np.ndarray) -> bool:
    """Return whether the array is in memory with its second axis first; it is then sent in that order."""
    return not array.flags.c_contiguous and array.ndim >= 2 and array.swapaxes(0, 1).flags.c_contiguous


# ------------------------------------------------------------------------------------------- reading


def _split(data: bytes, limits: Limits, *, any_version: bool = False) -> tuple[int, bytes, memoryview]:
    if len(data) < _PREFIX.size:
        raise ProtocolError(f"{len(data)} bytes are too few for a message")
    magic, version, flags, header_length = _PREFIX.unpack_from(data)
    if magic != _MAGIC:
        raise ProtocolError("not a message of this protocol")
    if not FIRST_VERSION <= version <= PROTOCOL_VERSION and not any_version:
        raise VersionMismatchError(version)
    if flags not in (_PLAIN, _ZSTD):
        raise ProtocolError(f"unknown flags {flags}")
    if header_length > limits.max_header_bytes:
        raise ProtocolError(f"the header declares {header_length} bytes, the limit is {limits.max_header_bytes}")
    if len(data) > limits.max_bytes + header_length + _PREFIX.size + _ALIGNMENT:
        raise ProtocolError(f"a message of {len(data)} bytes, the limit is {limits.max_bytes}")
    end = _PREFIX.size + header_length
    body_start = end + -end % _ALIGNMENT
    if body_start > len(data):
        raise ProtocolError("the message ends within its header")
    return flags, data[_PREFIX.size : end], memoryview(data)[body_start:]


def _read_header(header: bytes) -> tuple[str, dict[str, Any], list[Any], int]:
    try:
        content = msgpack.unpackb(header, raw=False, strict_map_key=True, max_ext_len=0, max_bin_len=0)
    except Exception as error:  # msgpack raises ValueError, UnicodeDecodeError and exceptions of its own
        raise ProtocolError(f"unreadable header: {type(error).__name__}") from None
    if not isinstance(content, dict) or content.keys() != {"kind", "fields", "arrays", "size"}:
        raise ProtocolError("the header must have exactly kind, fields, arrays and size")
    kind, fields, arrays, size = content["kind"], content["fields"], content["arrays"], content["size"]
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ProtocolError("unknown kind of message")
    if not isinstance(fields, dict) or not isinstance(arrays, list) or type(size) is not int or size < 0:
        raise ProtocolError("the header's fields, arrays or size have the wrong type")
    return kind, fields, arrays, size


def _first_fault(error: ValidationError) -> str:
    count = error.error_count()
    if count > _MAX_DESCRIBED:
        return f"{count:,} values are not valid"
    first = error.errors()[0]
    return ": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))


class _Entry(NamedTuple):
    """Position of one array in the body."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    swapped: bool
    offset: int


def _read_layout(arrays: list[Any], size: int, limits: Limits) -> list[_Entry]:
    """Return the position of each array. Raises ProtocolError if they do not fill the body exactly."""
    if len(arrays) > limits.max_arrays:
        raise ProtocolError(f"{len(arrays)} arrays, the limit is {limits.max_arrays}")
    layout, offset, names = [], 0, set()
    for entry in arrays:
        if not isinstance(entry, list) or len(entry) != 4:
            raise ProtocolError("an array must have a name, a dtype, a shape and whether it is swapped")
        name, dtype, shape, swapped = entry
        if not isinstance(name, str) or name in names:
            raise ProtocolError("array names must be distinct strings")
        if not isinstance(dtype, str) or dtype not in _DTYPES:
            raise ProtocolError(f"array {name!r} has an unsupported dtype")
        if not isinstance(shape, list) or len(shape) > _MAX_DIMENSIONS:
            raise ProtocolError(f"array {name!r} has an invalid shape")
        for side in shape:
            if type(side) is not int or not 0 <= side <= limits.max_bytes:
                raise ProtocolError(f"array {name!r} has an invalid shape")
        if type(swapped) is not bool or (swapped and len(shape) < 2):
            raise ProtocolError(f"array {name!r} has an invalid swapped flag")
        layout.append(_Entry(name, _DTYPES[dtype], tuple(shape), swapped, offset))
        names.add(name)
        length = math.prod(shape) * _DTYPES[dtype].itemsize
        offset += length + -length % _ALIGNMENT
    if offset != size:
        raise ProtocolError(f"the arrays take {offset} bytes, the body declares {size}")
    return layout


def _plain_body(flags: int, body: memoryview, size: int) -> bytes | memoryview:
    if flags == _PLAIN:
        if len(body) != size:
            raise ProtocolError(f"the body has {len(body)} bytes, it declares {size}")
        return body
    try:
        # python-zstandard ignores max_output_size if the frame declares its size, so check the declared size first.
        if zstandard.frame_content_size(body) != size:
            raise ProtocolError("the compressed frame declares another size than the header")
        plain = _zstd.decompressor.decompress(body, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise ProtocolError(f"unreadable body: {error}") from None
    if len(plain) != size:
        raise ProtocolError("the body decompresses to another size than declared")
    return plain


def _read_arrays(layout: list[_Entry], body: bytes | memoryview) -> _Arrays:
    arrays: _Arrays = {}
    for name, dtype, shape, swapped, offset in layout:
        sides = (shape[1], shape[0], *shape[2:]) if swapped else shape
        try:
            array = np.ndarray(sides, dtype, body, offset)
        except ValueError:  # the product of the sides overflows although one of them is 0
            raise ProtocolError(f"array {name!r} has an invalid shape") from None
        if dtype.char == "?" and array.size and array.view(np.uint8).max() > 1:
            raise ProtocolError(f"array {name!r} has a bool that is neither 0 nor 1")
        if swapped:
            array = array.swapaxes(0, 1)
        array.flags.writeable = False
        field, in_map, key = name.partition("/")
        if in_map:
            cast(dict[str, np.ndarray], arrays.setdefault(field, {}))[key] = array
        else:
            arrays[name] = array
    return arrays


class _Zstd(threading.local):
    """zstd contexts of one thread: they are expensive to create and must not be shared between threads."""

    def __init__(self) -> None:
        self.compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self.bytes_compressor = zstandard.ZstdCompressor(level=_BYTES_LEVEL)
        self.decompressor = zstandard.ZstdDecompressor()


_zstd = _Zstd()
