"""Base class and number types of the pydantic models, their fields by path, and the texts below the fields."""

import ast
import inspect
from collections.abc import Iterator
from itertools import pairwise
from textwrap import dedent
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

PositiveInt = Annotated[int, Field(ge=1)]
NaturalInt = Annotated[int, Field(ge=0)]
UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]


class Specification(BaseModel):
    """Base of all models: immutable, rejects unknown fields and numbers that are not finite.

    In a message, unknown fields are ignored: codec.py reads it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def changed_fields(specification: Specification, prefix: str = "") -> Iterator[str]:
    """Yield the path of each field that has another value than its default, such as `environment.grey`."""
    for name, field in type(specification).model_fields.items():
        value = getattr(specification, name)
        if isinstance(value, Specification):
            yield from changed_fields(value, f"{prefix}{name}.")
        elif field.is_required() or value != field.get_default(call_default_factory=True):
            yield prefix + name


def has_field(model: type[BaseModel], path: str) -> bool:
    """Return whether a model has the field with a path."""
    name, _, rest = path.partition(".")
    field = model.model_fields.get(name)
    if field is None or not rest:
        return field is not None
    inner = field.annotation
    return isinstance(inner, type) and issubclass(inner, BaseModel) and has_field(inner, rest)


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Return the text below each field that has one, in one line, from the sources of the model and its bases.

    pydantic can do this for each model that is imported (`use_attribute_docstrings`), which takes every process longer
    than the rest of its models together. Without the source the map is empty.
    """
    found = {}
    for base in reversed(model.__mro__):
        if issubclass(base, Specification) and base is not Specification:
            found |= _own_meanings(base)
    return found


def _own_meanings(model: type[BaseModel]) -> dict[str, str]:
    try:
        tree = ast.parse(dedent(inspect.getsource(model)))
    except OSError:
        return {}
    definition = tree.body[0]
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, below in pairwise(definition.body):
        match field, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                found[name] = " ".join(text.split())
    return found
