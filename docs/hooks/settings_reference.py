"""Reference of all settings, generated from the models in protocol/spec.py when the site is built.

The marker `<!-- settings -->` in a page is replaced by one table for each section of a run's `config.toml`.
"""

import typing
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from daedalus.protocol.models import meanings
from daedalus.protocol.spec import RunSpec

MARKER = "<!-- settings -->"
_BOUNDS = {Ge: ("ge", "≥"), Gt: ("gt", ">"), Le: ("le", "≤"), Lt: ("lt", "<")}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert the tables where a page has the marker. MkDocs calls this function."""
    return markdown.replace(MARKER, settings_tables()) if MARKER in markdown else markdown


def settings_tables() -> str:
    """Return the reference as Markdown: a heading and a table for each section."""
    return "\n\n".join(_section(name, field.annotation) for name, field in RunSpec.model_fields.items())


def _section(name: str, model: Any) -> str:
    assert issubclass(model, BaseModel)
    title = (model.__doc__ or "").strip().replace("\n    ", "\n")
    texts = meanings(model)
    rows = [_row(name, key, field, texts.get(key, "")) for key, field in model.model_fields.items()]
    return "\n".join(
        [f"## {name}", "", title, "", "| setting | type | range | default | meaning |", "|---|---|---|---|---|", *rows]
    )


def _row(section: str, key: str, field: FieldInfo, meaning: str) -> str:
    kind = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
    cells = (f"`{section}.{key}`", _type(kind), _range(kind), _default(field), meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None:
        return "unset"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f"`{value}`" if isinstance(value, str | dict) else f"`{value:,}`"


def _type(kind: Any) -> str:
    """Return a type in the words of TOML: `int`, `text`, `list of float`."""
    kind = _bare(kind)
    if get_origin(kind) is typing.Literal:
        return " ".join(f"`{choice}`" for choice in get_args(kind))
    if get_origin(kind) is tuple:
        return f"list of {_type(get_args(kind)[0])}"
    if get_origin(kind) is dict:
        return "table"
    return {str: "text"}.get(kind, getattr(kind, "__name__", str(kind)))


def _range(kind: Any) -> str:
    """Return the bounds of a value, or of the elements and the length of a list; empty if there are none."""
    found = _constraints(kind)
    signs = [
        f"{sign} {_number(getattr(c, name))}" for c in found for t, (name, sign) in _BOUNDS.items() if isinstance(c, t)
    ]
    bare = _bare(kind)
    if get_origin(bare) is tuple:
        element = _range(get_args(bare)[0])
        signs += [f"each {element}"] if element else []
        if Ellipsis not in get_args(bare):
            return ", ".join([f"{len(get_args(bare))} values", *signs])
    least = next((f"{c.min_length} to" for c in found if isinstance(c, MinLen)), "at most")
    what = "characters" if bare is str else "values"
    signs += [f"{least} {c.max_length:,} {what}" for c in found if isinstance(c, MaxLen)]
    return ", ".join(signs)


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def _bare(kind: Any) -> Any:
    """Return a type without its constraints and without `None`."""
    if get_origin(kind) is Annotated:
        return _bare(get_args(kind)[0])
    if get_origin(kind) in (UnionType, typing.Union):
        return _bare(next(part for part in get_args(kind) if part is not NoneType))
    return kind


def _constraints(kind: Any) -> list[Any]:
    """Return what pydantic checks of a value, at every depth but a list's elements."""
    if get_origin(kind) in (UnionType, typing.Union):
        return [c for part in get_args(kind) for c in _constraints(part)]
    if get_origin(kind) is not Annotated:
        return []
    first, *rest = get_args(kind)
    metadata = [c for part in rest for c in (part.metadata if isinstance(part, FieldInfo) else [part])]
    return _constraints(first) + metadata
