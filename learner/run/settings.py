"""Presets, TOML files and `--set` assignments -> a validated RunSpec. Every error message is one line."""

import difflib
import importlib.resources
import re
import shlex
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from daedalus.protocol.algorithms import check_algorithm
from daedalus.protocol.spec import RunSpec, TrainingSpec
from daedalus.protocol.specification import meanings

_FORMS = {"environment.wrap": "module:function"}  # of settings whose description does not begin with their form


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
        raise SettingsError(_unknown_preset(name))
    text = (importlib.resources.files("daedalus.learner.run.presets") / f"{name}.toml").read_text("utf-8")
    return tomllib.loads(text)


def _unknown_preset(name: str) -> str:
    """Return the error message for a name that is no preset, with what its user may have meant."""
    if (Path(name) / "config.toml").exists():
        directory, config = shlex.quote(name), shlex.quote(f"{name}/config.toml")
        return (
            f"{name} is a run directory: continue it with `daedalus resume {directory}`, or start a new run with its "
            f"settings with `daedalus train {config}`"
        )
    if ":" in name or re.search(r"-v\d+$", name):
        command = f"daedalus train --env {shlex.quote(name)}"
        return f"unknown preset {name!r}: an environment is named with --env, such as with: {command}"
    near = difflib.get_close_matches(name, preset_names(), 3, 0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"the presets are {', '.join(preset_names())}."
    return f"unknown preset {name!r}: {hint} Any gymnasium environment runs with --env ID"


def read_file(path: Path) -> dict[str, Any]:
    """Return the settings in a TOML file, such as the config.toml of a run, by section. Raises SettingsError."""
    try:
        settings = tomllib.loads(path.read_text("utf-8-sig"))  # some editors of Windows begin a file with a mark
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path} is not valid TOML: {error}") from None
    if outside := [name for name, value in settings.items() if not isinstance(value, dict)]:
        raise SettingsError(
            f"{path}: {outside[0]} is a value outside of the sections: write it below a section, such as [environment]"
        )
    return settings


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

    Raises SettingsError if `for_algorithm` is not a table of sections, or names an unknown algorithm or setting, also
    for another algorithm.
    """
    training = settings.setdefault("training", {})
    if algorithm is not None:
        training["algorithm"] = algorithm
    tables = settings.pop("for_algorithm", {})
    _check_for_algorithm(tables)
    chosen = training.get("algorithm", TrainingSpec.model_fields["algorithm"].default)
    for section, values in (tables.get(chosen, {}) if isinstance(chosen, str) else {}).items():
        for key, value in values.items():
            _assign(settings.setdefault(section, {}), key, value)


def _check_for_algorithm(tables: Any) -> None:
    for name, table in tables.items() if isinstance(tables, dict) else [("", None)]:
        if not isinstance(table, dict) or not all(isinstance(section, dict) for section in table.values()):
            raise SettingsError(
                "for_algorithm is not a table of sections: write [for_algorithm.NAME.SECTION], "
                "such as [for_algorithm.a3c.training]"
            )
        try:
            check_algorithm(name)
        except ValueError as error:
            raise SettingsError(f"for_algorithm.{name} {error}") from None
        for section, values in table.items():
            for path in [[section], *([section, key] for key in values)]:
                if path[-1] not in _known_names(path[:-1]):
                    raise SettingsError(_unknown_setting(["for_algorithm", name, *path], path[:-1]))


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
        return _unknown_setting(path, path[:-1])
    if first["type"] == "missing":
        return f"setting {name} is missing: add it"
    value, message = first["input"], first["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if not name:
        return message
    if first["type"] == "string_too_short" and value == "":  # a NumPy array has no truth value
        return f"setting {name} is empty"
    if first["type"] == "tuple_type":
        return f"setting {name} is {value!r}{_as_list(name, value)}"
    if first["type"] == "string_pattern_mismatch":
        hint = f": write {_FORMS[name]}" if name in _FORMS else f". {_description(path)}"
        return f"setting {name} is {value!r}, which is not valid{hint}"
    bounds = _bounds(path)
    return f"setting {name} {message}, not {value!r}{f' (it must be {bounds})' if bounds else ''}"


def _unknown_setting(path: list[str], section: list[str]) -> str:
    known = _known_names(section)
    near = difflib.get_close_matches(path[-1], known, 3, 0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"the settings are {', '.join(known)}"
    return f"unknown setting {'.'.join(path)}: {hint}"


def _as_list(name: str, value: Any) -> str:
    """Return why a value is not a list, and how to write one. A shell removes the quotes of texts in a list."""
    if not isinstance(value, str):
        return f", which is not a list: write {name}=[{value}]"
    if value.startswith("[") and not value.endswith("]"):
        return ": the closing bracket is missing"
    parts = [part.strip() for part in value.strip("[]").split(",")]
    return f', which is not a list: write --set "{name}={parts}"'


def _description(path: list[str]) -> str:
    """Return the description of a setting, or of the list that it is part of, in one line, or an empty string."""
    path = [part for part in path if not part.isdigit()]
    model = _model(path[:-1])
    return meanings(model).get(path[-1], "") if model else ""


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
            f"{text} {_plain(getattr(constraint, key))}"
            for key, text in words.items()
            if getattr(constraint, key, None) is not None
        ]
    return " and ".join(found)


def _plain(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"
