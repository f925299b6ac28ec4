"""Base class and number types of the pydantic models, and the texts below their fields."""

import ast
import inspect
from itertools import pairwise
from textwrap import dedent
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

PositiveInt = Annotated[int, Field(ge=1)]
NaturalInt = Annotated[int, Field(ge=0)]
UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]


class Specification(BaseModel):
    """Base of all models: immutable, rejects unknown fields and numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Return the text below each field that has one, in one line, from the source of the model.

    pydantic can do this for each model that is imported (`use_attribute_docstrings`), which takes every process longer
    than the rest of its models together. Without the source the map is empty.
    """
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
