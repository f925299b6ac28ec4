"""`daedalus settings`: print the settings of a run with their defaults, limits and meanings, from protocol/spec.py."""

import argparse
import difflib
import sys
import textwrap
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from daedalus.cli.arguments import command_parser
from daedalus.launch.logs import print_error, say
from daedalus.launch.process_lifecycle import BAD_USAGE
from daedalus.protocol.models import meanings
from daedalus.protocol.spec import RunSpec

_DESCRIPTION = """\
Prints the settings of a run: for each its default, type, limits and meaning. A preset or a TOML file sets them in
tables, `--set SECTION.KEY=VALUE` on the command line."""

_EXAMPLES = """\
examples:
  daedalus settings
  daedalus settings collection
  daedalus settings training.learning_rate
  daedalus settings clip"""

_BOUNDS = {Ge: ("ge", "≥"), Gt: ("gt", ">"), Le: ("le", "≤"), Lt: ("lt", "<")}


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus settings`."""
    options = command_parser("settings", _DESCRIPTION, _EXAMPLES)
    options.add_argument("name", nargs="?", metavar="NAME", help="a section, a setting, or a part of a setting's name")
    return options


def settings(arguments: list[str]) -> int:
    """Run `daedalus settings` and return its exit status."""
    name: str | None = parser().parse_args(arguments).name
    found = [setting for setting in all_settings() if name is None or _matches(setting, name)]
    if name is not None and not found:
        known = [each for setting in all_settings() for each in (setting.path, setting.key)]
        near = " or ".join(difflib.get_close_matches(name, known, 2, 0.5))
        hint = f"did you mean {near}?" if near else f"the sections are {', '.join(RunSpec.model_fields)}"
        print_error("settings", f"no setting is named {name!r}: {hint}")
        return BAD_USAGE
    for setting in found:
        kind = f"one of {setting.kind.replace('` `', ', ')}" if "` `" in setting.kind else setting.kind
        facts = ", ".join(filter(None, (kind.replace("`", ""), setting.limits)))
        say(f"{setting.path} = {setting.default.replace('`', '')}  ({facts})", sys.stdout)
        say(textwrap.indent(textwrap.fill(setting.meaning.replace("`", ""), 96), "    "), sys.stdout)
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One setting of a run, in words: Markdown, in which values are code."""

    section: str
    key: str
    kind: str  # in the words of TOML: `int`, `list of float`, or the choices
    limits: str  # of a value, or of the elements and the length of a list; empty if there are none
    default: str
    meaning: str

    @property
    def path(self) -> str:
        """Its name on the command line."""
        return f"{self.section}.{self.key}"


def sections() -> dict[str, type[BaseModel]]:
    """Return the model of each section of a run's settings; that of a table of sections is `section.NAME`."""
    models: dict[str, type[BaseModel]] = {}
    for name, field in RunSpec.model_fields.items():
        if get_origin(field.annotation) is dict:
            models[f"{name}.NAME"] = get_args(field.annotation)[1]
        else:
            models[name] = typing.cast(type[BaseModel], field.annotation)
    return models


def all_settings() -> Iterator[Setting]:
    """Yield every setting, in the order of `config.toml`."""
    for section, model in sections().items():
        texts = meanings(model)
        for key, field in model.model_fields.items():
            kind = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
            yield Setting(
                section=section,
                key=key,
                kind=_type(kind),
                limits=_range(kind),
                default=_default(field),
                meaning=texts.get(key, ""),
            )


def _matches(setting: Setting, name: str) -> bool:
    if name in RunSpec.model_fields:
        return setting.section.partition(".")[0] == name
    return setting.path == name if "." in name else name in setting.key


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
        signs += [f"each {element.removeprefix('each ')}"] if element else []  # of the innermost list
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
