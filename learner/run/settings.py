"""Presets, TOML files and `--set` assignments -> a validated RunSpec. Every error message is one line."""

import difflib
import importlib.resources
import re
import shlex
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from daedalus.learner.run.run_files import RunDataError, read_toml
from daedalus.learner.run.setting_errors import known_names, one_line, unknown_setting
from daedalus.protocol.algorithms import check_algorithm
from daedalus.protocol.spec import RunSpec, TrainingSpec


class SettingsError(Exception):
    """Error for invalid settings. The message names the setting, the reason and the correction."""


def preset_names() -> list[str]:
    """Return the names of the presets that ship with the package, sorted."""
    folder = importlib.resources.files("daedalus.learner.run.presets")
    return sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml"))


def read_preset(name: str) -> dict[str, Any]:
    """Return the settings of a preset, or of a TOML file if `name` ends with ".toml". Raises SettingsError."""
    if name.endswith(".toml"):
        return read_settings(Path(name))
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
    if name.endswith(".py"):
        module = Path(name).stem
        return f"{name} is a module, not a preset: register an environment in it, and name it as --env {module}:ID"
    if ":" in name or re.search(r"-v\d+$", name):
        command = f"daedalus train --env {shlex.quote(name)}"
        in_python = f"in Python: daedalus.train(env={name!r})"
        return f"unknown preset {name!r}: an environment is named with --env, such as with: {command} ({in_python})"
    near = difflib.get_close_matches(name, preset_names(), 3, 0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"the presets are {', '.join(preset_names())}."
    return f"unknown preset {name!r}: {hint} Any gymnasium environment runs with --env ID"


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings in a TOML file, such as the config.toml of a run, by section. Raises SettingsError."""
    try:
        settings = read_toml(path)
    except RunDataError as error:
        raise SettingsError(str(error)) from None
    if settings is None:
        raise SettingsError(f"{path} does not exist")
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
                if path[-1] not in known_names(path[:-1]):
                    raise SettingsError(unknown_setting(["for_algorithm", name, *path], path[:-1]))


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
        raise SettingsError(one_line(error)) from None
