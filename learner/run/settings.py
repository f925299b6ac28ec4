"""Presets, TOML files and `--set` assignments -> a validated RunSpec. Every error message is one line."""

import difflib
import importlib.resources
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from daedalus.protocol.spec import RunSpec


class SettingsError(Exception):
    """Error for invalid settings. The message names the setting, the reason and the correction."""


def preset_names() -> list[str]:
    """Return the names of the presets that ship with the package, sorted."""
    folder = importlib.resources.files("daedalus.learner.run.presets")
    return sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml"))


def read_preset(name: str) -> dict[str, Any]:
    """Return the settings of a preset, or of a TOML file if `name` ends with ".toml". Raises SettingsError."""
    if name.endswith(".toml"):
        return read_file(Path(name))
    if name not in preset_names():
        near = difflib.get_close_matches(name, preset_names(), 3, 0.5)
        hint = f"did you mean {' or '.join(near)}?" if near else f"the presets are {', '.join(preset_names())}"
        raise SettingsError(f"unknown preset {name!r}: {hint}; any gymnasium environment runs with --env ID")
    text = (importlib.resources.files("daedalus.learner.run.presets") / f"{name}.toml").read_text("utf-8")
    return tomllib.loads(text)


def read_file(path: Path) -> dict[str, Any]:
    """Return the settings in a TOML file, such as the config.toml of a run. Raises SettingsError."""
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path} is not valid TOML: {error}") from None


def override(settings: dict[str, Any], assignments: Sequence[str]) -> None:
    """Apply `section.key=value` assignments in place. A value that is not valid TOML is a plain string.

    Raises SettingsError for an assignment that is not of this form.
    """
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals or "." not in path:
            raise SettingsError(f"--set {assignment}: write section.key=value, such as training.learning_rate=0.001")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text
        try:
            assign(settings, path, value)
        except SettingsError as error:
            raise SettingsError(f"--set {assignment}: {error}") from None


def assign(settings: dict[str, Any], path: str, value: Any) -> None:
    """Set `section.key` to a value in place; None and "none" unset it. Raises SettingsError for an invalid path."""
    *sections, key = path.strip().split(".")
    if not sections:
        raise SettingsError(f"{path!r} has no section: write section.key, such as training.learning_rate")
    section = settings
    for name in sections:
        section = section.setdefault(name, {})
        if not isinstance(section, dict):
            raise SettingsError(f"{name} is a value, not a section: remove the part after {name}")
    _assign(section, key, value)


def choose_algorithm(settings: dict[str, Any], algorithm: str | None) -> None:
    """Set the algorithm, unless it is None, and apply the preset's `[for_algorithm.NAME]` settings for it.

    Raises SettingsError if `for_algorithm` is not a table of sections.
    """
    training = settings.setdefault("training", {})
    if algorithm is not None:
        training["algorithm"] = algorithm
    tables = settings.pop("for_algorithm", {})
    table = tables.get(training.get("algorithm"), {}) if isinstance(tables, dict) else tables
    if not isinstance(table, dict) or not all(isinstance(section, dict) for section in table.values()):
        raise SettingsError(
            "for_algorithm is not a table of sections: write [for_algorithm.NAME.SECTION], "
            "such as [for_algorithm.a3c.training]"
        )
    for section, values in table.items():
        for key, value in values.items():
            _assign(settings.setdefault(section, {}), key, value)


def _assign(section: dict[str, Any], key: str, value: Any) -> None:
    if value is None or (isinstance(value, str) and value == "none"):  # TOML has no null value
        section.pop(key, None)
    else:
        section[key] = value


def run_spec(settings: dict[str, Any]) -> RunSpec:
    """Return the validated specification. Raises SettingsError, which names the first invalid setting."""
    try:
        return RunSpec.model_validate(settings)
    except ValidationError as error:
        raise SettingsError(_one_line(error)) from None


def _one_line(error: ValidationError) -> str:
    first = error.errors()[0]
    path = [str(part) for part in first["loc"]]
    name = ".".join(path)
    if first["type"] == "extra_forbidden":
        known = _known_names(path[:-1])
        near = difflib.get_close_matches(path[-1], known, 3, 0.5)
        hint = f"did you mean {' or '.join(near)}?" if near else f"the settings are {', '.join(known)}"
        return f"unknown setting {name}: {hint}"
    if first["type"] == "missing":
        return f"setting {name} is missing: add it"
    value, message = first["input"], first["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if not name:
        return message
    if first["type"] == "tuple_type":
        return f"setting {name} is {value!r}, which is not a list: write {_as_list(name, value)}"
    if first["type"] == "string_pattern_mismatch":
        return f"setting {name} is {value!r}, which is not valid. {_description(path)}"
    bounds = _bounds(path)
    return f"setting {name} {message}, not {value!r}{f' (it must be {bounds})' if bounds else ''}"


def _as_list(name: str, value: Any) -> str:
    """Return an assignment of a list. A shell removes the quotes of texts, so that no valid list is left."""
    if not isinstance(value, str):
        return f"{name}=[{value}]"
    parts = [part.strip() for part in value.strip("[]").split(",")]
    return f'--set "{name}={parts}"'


def _description(path: list[str]) -> str:
    """Return the description of a setting, or of the list that it is part of, in one line, or an empty string."""
    path = [part for part in path if not part.isdigit()]
    model = _model(path[:-1])
    field = model.model_fields.get(path[-1]) if model else None
    return " ".join((field.description or "").split()) if field else ""


def _known_names(path: list[str]) -> list[str]:
    model = _model(path)
    return sorted(model.model_fields) if model else []


def _model(path: list[str]) -> type[BaseModel] | None:
    model: Any = RunSpec
    for part in path:
        field = model.model_fields.get(part)
        if field is None or not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            return None
        model = field.annotation
    return model


def _bounds(path: list[str]) -> str:
    """Return the allowed range of a setting in words, or an empty string if it has no bounds."""
    model = _model(path[:-1])
    field = model.model_fields.get(path[-1]) if model else None
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    found = []
    for constraint in field.metadata if field else ():
        found += [
            f"{text} {getattr(constraint, key):g}"
            for key, text in words.items()
            if getattr(constraint, key, None) is not None
        ]
    return " and ".join(found)
