"""The error message for invalid settings, in one line. Pure functions."""

import difflib
from collections.abc import Iterable
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from daedalus.protocol.models import meanings
from daedalus.protocol.releases import REPLACED_SETTINGS, REPLACED_VALUES
from daedalus.protocol.spec import RunSpec

_FORMS = {"environment.wrap": "module:function"}  # of settings whose description does not begin with their form


def one_line(error: ValidationError) -> str:
    """Return the message for the first setting that is invalid."""
    errors = error.errors()
    # A value of a union has an error for each member: the deepest is that of the member that was meant.
    same = [each for each in errors if each["loc"][:2] == errors[0]["loc"][:2]]
    first = max(same, key=lambda each: len(each["loc"]))
    path = _path(first["loc"])
    name, kind = ".".join(path), first["type"]
    if kind == "extra_forbidden":
        return unknown_setting(path, path[:-1])
    value, message = first["input"], first["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if kind in ("missing", "too_long") and _fixed_length(_without_indices(path)):
        path = _without_indices(path)
        return f"setting {'.'.join(path)} is {value!r}{_as_list(path, value)}"
    if kind == "missing":
        return f"setting {name} is missing: add it"
    if not name:
        return message
    if kind == "model_type" and len(path) > 1:  # of a table of tables, each with a name
        known = known_names(path)
        if path[-1] in known:
            return f"setting {name} does not say of what: write {path[0]}.NAME.{path[-1]}, with the name of a parameter"
        return f"setting {name} is {value!r}, and not one of its settings: write {name}.{f', {name}.'.join(known)}"
    if kind == "string_too_short" and value == "":  # a NumPy array has no truth value
        return f"setting {name} is empty"
    if kind == "tuple_type":
        return f"setting {name} is {value!r}{_as_list(path, value)}"
    if replacement := isinstance(value, str) and REPLACED_VALUES.get((name, value)):
        return f"setting {name} is {value!r}, which is of an earlier release: {replacement!r} replaces it"
    if kind == "string_pattern_mismatch":
        hint = f": write {_FORMS[name]}" if name in _FORMS else f". {_description(path)}"
        return f"setting {name} is {value!r}, which is not valid{hint}"
    bounds = _bounds(path)
    return f"setting {name} {message}, not {value!r}{f' (it must be {bounds})' if bounds else ''}"


def ambiguous(path: list[str], value: Any) -> str:
    """Return what pydantic would convert without a word in the value of a setting, or an empty string.

    It takes true for the number 1, and a set, which has no order, for a list.
    """
    kinds = types_of(path)
    if isinstance(value, set | frozenset):
        return f"{value!r}, which has no order: write a list"
    if isinstance(value, list | tuple):
        return next((found for part in value if (found := ambiguous(path, part))), "")
    if isinstance(value, dict) and any(get_origin(kind) is dict for kind in kinds):
        return next((found for part in value.values() if (found := ambiguous(path, part))), "")
    if not isinstance(value, bool | np.bool_) or bool in kinds or {int, float}.isdisjoint(_numbers(kinds)):
        return ""
    return f"{str(value).lower()}, which is no number: write a number"


def _numbers(kinds: Iterable[Any]) -> set[Any]:
    """Return the types of the values in values of these types: of a list, those of its elements."""
    inner = [_bare(part) for kind in kinds for part in get_args(kind) if part is not ...]
    return {*kinds, *(_numbers(inner) if inner else ())}


def _path(location: tuple[int | str, ...]) -> list[str]:
    """Return the names in the location of an error, without those that pydantic gives the members of a union."""
    path: list[str] = []
    is_member = False
    for part in location:
        if not is_member:
            path.append(str(part))
        is_member = not is_member and len(types_of(path)) > 1
    return path


def unknown_setting(path: list[str], section: list[str]) -> str:
    """Return the message for a name that is not in a section of the settings, with what its user may have meant."""
    name, known = ".".join(path), known_names(section)
    if replacement := REPLACED_SETTINGS.get(".".join([*section, path[-1]])):
        return f"setting {name} is of an earlier release: {replacement} replaces it"
    near = [".".join([*path[:-1], name]) for name in difflib.get_close_matches(path[-1], known, 3, 0.5)]
    hint = f"did you mean {' or '.join(near)}?" if near else f"the settings are {', '.join(known)}"
    return f"unknown setting {name}: {hint}"


def _as_list(path: list[str], value: Any) -> str:
    """Return why a value is not the list that a setting needs, and how to write one where that is known."""
    name, element = ".".join(path), _element(path)
    if isinstance(value, str) and value.startswith("[") and not value.endswith("]"):
        return ": the closing bracket is missing"
    if length := _fixed_length(path):
        return f": it must be a list of {length} numbers. {_description(path)}"
    if element is str and isinstance(value, str):
        parts = [part.strip() for part in value.strip("[]").split(",")]
        return f', which is not a list: write --set "{name}={parts}"'  # a shell removes the quotes of texts in a list
    if element in (int, float) and not isinstance(value, dict) and not str(value).startswith("["):
        return f", which is not a list: write {name}=[{value}]"
    return ", which is not a list"


def _element(path: list[str]) -> Any:
    """Return the type of the elements of a setting that is a list; None if there is no such setting."""
    for kind in types_of(path):
        if get_origin(kind) is tuple:
            return _bare(get_args(kind)[0])
    return None


def _fixed_length(path: list[str]) -> int:
    """Return the length of the list that a setting is, or 0 if it is no list or its length is not fixed."""
    kinds = types_of(path)
    if len(kinds) != 1 or get_origin(kinds[0]) is not tuple or ... in get_args(kinds[0]):
        return 0
    return len(get_args(kinds[0]))


def _without_indices(path: list[str]) -> list[str]:
    return [part for part in path if not part.isdigit()]


def _description(path: list[str]) -> str:
    """Return the description of a setting, or of the list that it is part of, in one line, or an empty string."""
    path = _without_indices(path)
    model = _model(path[:-1])
    return meanings(model).get(path[-1], "") if model else ""


def known_names(path: list[str]) -> list[str]:
    """Return the names in a section of the settings, sorted; empty if there is no such section."""
    model = _model(path)
    return sorted(model.model_fields) if model else []


def _model(path: list[str]) -> type[BaseModel] | None:
    model: Any = RunSpec
    for part in path:
        if get_origin(model) is dict:  # of models by name
            model = get_args(model)[1]
            continue
        field = model.model_fields.get(part)
        model = None if field is None else field.annotation
        values = get_args(model)[1:] if get_origin(model) is dict else [model]
        if not all(isinstance(each, type) and issubclass(each, BaseModel) for each in values):
            return None
    return model if isinstance(model, type) else None


def _field(path: list[str]) -> FieldInfo | None:
    model = _model(path[:-1]) if path else None
    return model.model_fields.get(path[-1]) if model else None


def types_of(path: list[str]) -> list[Any]:
    """Return the types that a setting may have besides None; empty if there is no such setting."""
    field = _field(path)
    if field is None:
        table = _field(path[:2]) if len(path) > 2 else None  # such as league.opponents, whose names may have dots
        return [_bare(get_args(table.annotation)[1])] if table and get_origin(table.annotation) is dict else []
    is_union = get_origin(field.annotation) in (Union, UnionType)
    types = get_args(field.annotation) if is_union else (field.annotation,)
    return [_bare(each) for each in types if each is not NoneType]


def _bare(kind: Any) -> Any:
    """Return a type without its constraints."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _bounds(path: list[str]) -> str:
    """Return the allowed range of a setting in words, or an empty string if it has no bounds."""
    field = _field(path)
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    found = []
    for constraint in field.metadata if field else ():
        found += [
            f"{text} {_plain(getattr(constraint, key))}"
            for key, text in words.items()
            if getattr(constraint, key, None) is not None
        ]
    return " and ".join(found)


def _plain(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"
