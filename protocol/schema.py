"""Converting messages to plain maps and named arrays, and back, by the type annotations of the message classes.

Scalars, strings, nested messages and pydantic models go into the map; arrays are named by their path. Building a
message checks the type of every field that it has, and ignores all others. This file does not encode bytes.
"""

import dataclasses
import functools
import types
import typing
from typing import Any

import numpy as np
from pydantic import BaseModel


def pack(value: Any, path: str, arrays: list[tuple[str, np.ndarray]]) -> dict[str, Any]:
    """Return the fields of a message as a plain map, and append its arrays to `arrays`, named `path` + field."""
    packed: dict[str, Any] = {}
    for name, annotation in _fields(type(value)).items():
        item = getattr(value, name)
        if annotation is np.ndarray or isinstance(item, np.ndarray):
            arrays.append((path + name, item))
        elif _is_optional_array(annotation):
            pass  # without it
        elif _is_array_map(annotation):
            arrays.extend((f"{path}{name}/{key}", array) for key, array in item.items())
        elif dataclasses.is_dataclass(annotation):
            packed[name] = pack(item, f"{path}{name}.", arrays)
        elif isinstance(item, BaseModel):
            packed[name] = item.model_dump(mode="json")
        else:
            packed[name] = item
    return packed


def unpack(cls: type, fields: dict[str, Any], path: str, arrays: dict[str, np.ndarray]) -> Any:
    """Build a message of class `cls` from a map made by `pack`, and remove its arrays from `arrays`.

    A missing field has its default. Fields that the class does not have are ignored: a newer release wrote them.
    Raises ValueError, which names the field, for one that is missing without a default, or of the wrong type.
    """
    values: dict[str, Any] = {}
    optional = _optional(cls)
    for name, annotation in _fields(cls).items():
        if annotation is np.ndarray:
            if path + name not in arrays:
                raise ValueError(f"array {path + name!r} is missing")
            values[name] = arrays.pop(path + name)
        elif _is_optional_array(annotation):
            values[name] = arrays.pop(path + name, None)
        elif _is_array_map(annotation):
            prefix = f"{path}{name}/"
            found = [key for key in arrays if key.startswith(prefix)]
            values[name] = {key[len(prefix) :]: arrays.pop(key) for key in found}
        elif name in fields:
            values[name] = _value(annotation, fields[name], path + name, arrays)
        elif name not in optional:
            raise ValueError(f"field {path + name!r} is missing")
    return cls(**values)


def has_array(cls: type, name: str) -> bool:
    """Return whether messages of class `cls` have an array with this name."""
    annotation = _fields(cls).get(name.partition("/")[0])
    if "/" in name:
        return _is_array_map(annotation)
    return annotation is np.ndarray or _is_optional_array(annotation)


def _value(annotation: Any, item: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(annotation, types.UnionType):  # `X | None`
        if item is None:
            return None
        annotation = typing.get_args(annotation)[0]
    if dataclasses.is_dataclass(annotation):
        if not isinstance(item, dict):
            raise ValueError(f"field {path!r} must be a map")
        return unpack(typing.cast(type, annotation), item, path + ".", arrays)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation.model_validate(item, extra="ignore")
    if typing.get_origin(annotation) is typing.Literal:
        if not isinstance(item, str) or item not in typing.get_args(annotation):
            raise ValueError(f"field {path!r} must be one of {', '.join(typing.get_args(annotation))}")
        return item
    if type(item) is not annotation:
        raise ValueError(f"field {path!r} must be {annotation.__name__}, not {type(item).__name__}")
    if annotation is int and not 0 <= item < 2**63:
        raise ValueError(f"field {path!r} must be from 0 to 2^63 - 1")
    return item


@functools.cache
def _fields(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


@functools.cache
def _optional(cls: type) -> frozenset[str]:
    """Return the names of the fields that have a default."""
    missing = dataclasses.MISSING
    return frozenset(
        field.name
        for field in dataclasses.fields(cls)
        if field.default is not missing or field.default_factory is not missing
    )


def _is_optional_array(annotation: Any) -> bool:
    return annotation == np.ndarray | None


def _is_array_map(annotation: Any) -> bool:
    return typing.get_origin(annotation) is dict and typing.get_args(annotation)[1] is np.ndarray
