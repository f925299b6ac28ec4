"""Presets, TOML files and `--set` assignments -> a validated RunSpec. Every error message is one line."""

import ast
import datetime
import difflib
import importlib.resources
import json
import math
import re
import shlex
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import JsonValue, ValidationError

from daedalus.learner.run.run_files import RunDataError, read_toml
from daedalus.learner.run.setting_errors import ambiguous, known_names, one_line, unknown_setting
from daedalus.policy.component_inputs import encoded_spaces, normalized_components
from daedalus.protocol.algorithms import check_algorithm, is_own
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.spec import RunSpec, TrainingSpec
from daedalus.protocol.texts import exact_number, without_secrets

# Tables of arguments: their values have no type that would refuse a wrong one.
_TABLES = {
    (section, name)
    for section, sections in RunSpec.model_fields.items()
    for name, field in getattr(sections.annotation, "model_fields", {}).items()
    if field.annotation == dict[str, JsonValue]
}
_REPLAY = "sac"  # learns otherwise than all others, which share the settings of a preset
_NONE = "none"  # {none = true} stands for None in a table of arguments: TOML has no null value
_WORDS = {"true": "true", "yes": "true", "on": "true", "false": "false", "no": "false", "off": "false"} | dict.fromkeys(
    ("none", "null", "nil"), _NONE
)  # that mean a value elsewhere, in any case
_MOST_NESTED = 64


class SettingsError(Exception):
    """Error for invalid settings. The message names the setting, the reason and the correction."""


class DeviceError(SettingsError):
    """The device of the learner cannot be used now: it is missing, has too little memory or has failed."""


class DeviceLostError(DeviceError):
    """The device of the learner does not answer any more: what it holds is lost."""


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
    """Apply `section.key=value` assignments in place. See read_value for the value.

    Raises SettingsError for an assignment that is not of this form.
    """
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals or "." not in path:
            raise SettingsError(f"--set {assignment}: write section.key=value, such as training.learning_rate=0.001")
        try:
            assign(settings, path, read_value(path, text))
        except SettingsError as error:
            raise SettingsError(f"--set {assignment}: {error}") from None


def read_value(path: str, text: str) -> Any:
    """Return the value that a text means for a setting: TOML, a literal of Python or JSON, `none`, or plain text.

    The constructor of an environment or an algorithm takes any text, so that a text that looks like a value, and is
    none, is refused for its arguments. Raises SettingsError.
    """
    values = _literals(text)
    if len(values) == 1 and not text.rstrip().endswith(","):
        moment = isinstance(values[0], datetime.date | datetime.time)  # a text needs no quotes
        return text.strip() if moment else values[0]
    if text.strip() == _NONE:
        return None
    if _in_table(path):
        _check_plain_text(text, values)
    return text


def _literals(text: str) -> list[Any]:
    """Return the values that a text has with commas between them; empty if it is plain text."""
    listed = f"[{text}]"  # a comment would hide the bracket
    readers = (lambda: tomllib.loads(f"value = {listed}"), lambda: {"value": ast.literal_eval(listed)})
    for reader in (*readers, lambda: {"value": json.loads(listed)}):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # such as for an escape that Python does not know
                read = reader()
        except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError, Warning):
            continue
        if read.keys() == {"value"} and read["value"] != [...]:
            return read["value"]
    return []


def _check_plain_text(text: str, values: Sequence[Any]) -> None:
    """Raise SettingsError if a text for an argument was probably meant as another value."""
    bare = text.strip()
    quoted = f"{shlex.quote(json.dumps(bare, ensure_ascii=False))} for the text"
    if values:
        raise SettingsError(f"{bare} is several values: write [{bare}] for a list, or {quoted}")
    if meant := _WORDS.get(bare.casefold()):
        raise SettingsError(f"{bare} would be a text: write {meant}, or {quoted}")
    if bare.startswith(("[", "{", "(", '"', "'")):
        raise SettingsError(
            f'{bare} is neither TOML nor a literal of Python: write it as [8, true, "text"] or '
            '{size = 8, mode = "text"}, in quotation marks for the shell'
        )
    try:
        number = float(bare.replace("_", ""))
    except ValueError:
        return
    raise SettingsError(
        f"{bare} would be a text: write {f'{number:.15g}, or ' if math.isfinite(number) else ''}{quoted}"
    )


def _in_table(path: str) -> bool:
    """Return whether a path leads to a table of arguments, or into one."""
    return tuple(path.strip().split(".")[:2]) in _TABLES


def assign(settings: dict[str, Any], path: str, value: Any) -> None:
    """Set `section.key` to a value in place. Raises SettingsError for an invalid path.

    None and "none" unset a setting. An argument in a table, such as `environment.kwargs.size`, has any value.
    """
    *sections, key = path.strip().split(".")
    if not sections:
        raise SettingsError(f"{path!r} has no section: write section.key, such as training.learning_rate")
    section = settings
    for name in sections:
        section = section.setdefault(name, {})
        if not isinstance(section, dict):
            raise SettingsError(f"{name} is a value, not a section: remove the part after {name}")
    if len(sections) > 1 and _in_table(path):
        section[key] = value
    else:
        _assign(section, key, value)


def choose_algorithm(settings: dict[str, Any], algorithm: str | None) -> list[str]:
    """Set the algorithm, unless it is None, and apply the preset's `[for_algorithm.NAME]` settings for it.

    Return the settings that had other values before, as `section.key`.

    sac, where the preset is of another algorithm and has none for it, gets the settings in defaults/sac.toml.

    Raises SettingsError if `for_algorithm` is not a table of sections, or names an unknown algorithm or setting, also
    for another algorithm.
    """
    training = settings.setdefault("training", {})
    before = training.get("algorithm")
    if algorithm is not None:
        training["algorithm"] = algorithm
    tables = settings.pop("for_algorithm", {})
    _check_for_algorithm(tables)
    if algorithm == _REPLAY and before != _REPLAY and _REPLAY not in tables:
        file = importlib.resources.files("daedalus.learner.run.defaults") / f"{_REPLAY}.toml"
        tables = {_REPLAY: tomllib.loads(file.read_text("utf-8"))}
    chosen = training.get("algorithm", TrainingSpec.model_fields["algorithm"].default)
    replaced = []
    for section, values in (tables.get(chosen, {}) if isinstance(chosen, str) else {}).items():
        for key, value in values.items():
            present = settings.setdefault(section, {})
            if key in present and present[key] != value:
                replaced.append(f"{section}.{key}")
            _assign(present, key, value)
    return replaced


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
    plain = dict(settings)
    for section, values in plain.items():
        for key, value in values.items() if isinstance(values, dict) else ():
            if (section, key) not in _TABLES and (doubt := ambiguous([section, key], value)):
                raise SettingsError(f"setting {section}.{key} is {doubt}")
    for section, name in sorted(_TABLES):
        values = plain.get(section)
        if isinstance(values, dict) and isinstance(values.get(name), dict):
            arguments = {key: _plain(f"{section}.{name}.{key}", value) for key, value in values[name].items()}
            plain[section] = {**values, name: arguments}
    try:
        return RunSpec.model_validate(plain)
    except ValidationError as error:
        raise SettingsError(one_line(error)) from None


def value_text(value: Any) -> str:
    """Return a value of a setting in few characters."""
    if value is None:
        return "unset"
    if isinstance(value, float):
        return exact_number(value)
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def setting_text(value: object) -> str:
    """Return the value of a setting as text of limited length."""
    shown = without_secrets(value_text(value) if not isinstance(value, dict | list) else json.dumps(value))
    return shown if len(shown) <= 400 else f"{shown[:400]}..."


def flat_settings(sections: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of all sections by `section.key`, without values that are in no section."""
    return {
        f"{section}.{key}": value
        for section, values in sections.items()
        if isinstance(values, Mapping)
        for key, value in values.items()
    }


def changed_settings(settings: Mapping[str, Any]) -> list[str]:
    """Return which settings, by `section.key` as JSON has them, differ from the defaults of this release.

    The environment's id, which has no default, and settings of another release are among them.
    """
    defaults = flat_settings(RunSpec.model_validate({"environment": {"id": "none"}}).model_dump(mode="json"))
    del defaults["environment.id"]
    return [path for path, value in settings.items() if path not in defaults or value != defaults[path]]


_OF_GAUSSIANS = {  # distributions that read a setting
    "policy.initial_std": ("gaussian", "squashed_gaussian", "gaussian_mixture"),
    "policy.state_dependent_std": ("gaussian", "squashed_gaussian"),
    "policy.mixture_components": ("gaussian_mixture",),
}


def unread_settings(spec: RunSpec, spaces: Spaces | None = None) -> set[str]:
    """Return the settings of `policy`, `training` and `league` that nothing reads in a run with these others.

    `spaces` are those of the run, if they are known.
    """
    policy, training, record = spec.policy, spec.training, spec.algorithm
    if is_own(training.algorithm):
        return set()  # which may read any
    has_returns = record.heads == "policy_and_value"
    unread = {
        "training.passes training.minibatches training.clip_range training.surrogate": record.passes_over_batch,
        "training.proximal_policy": record.passes_over_batch and not training.explores,
        "training.trace_lambda": not record.replay and not training.algorithm.startswith("one_step"),
        "training.rho_clip": record.corrected or (has_returns and training.explores),
        "training.trace_clip": record.corrected,
        "training.target_period": record.target_network,
        "training.value_loss training.value_coefficient": not record.replay,
        "training.entropy_bonus training.entropy_bonus_final training.normalize_advantages": has_returns,
        "training.mean_first_value": has_returns and not spec.uploads_gradients,
        "training.replay_transitions training.replay_megabytes training.replay_saved training.replay_begin "
        "training.updates_per_env_step training.minibatch_rows training.n_step "
        "training.demonstration_share": record.replay,
        "training.cloning_updates training.cloning_weight": record.demonstrations and not record.replay,
        "training.rmsprop_decay": training.optimizer == "rmsprop",
        "training.exploration_env_steps": training.explores,
        "training.max_policy_lag": not record.synchronous,
        "policy.separate_value_encoder": has_returns and policy.memory == "none",
        "policy.memory_units": policy.memory != "none",
        **{name: policy.distribution in readers for name, readers in _OF_GAUSSIANS.items()},
        "league.target_win_rate": spec.league.target_opponent is not None,
    }
    found = {name for names, is_read in unread.items() if not is_read for name in names.split()}
    return found if spaces is None else found | _unread_with(spec, spaces)


def _unread_with(spec: RunSpec, spaces: Spaces) -> set[str]:
    """Return the settings of `policy` that nothing reads with these spaces."""
    policy, replay, found = spec.policy, spec.algorithm.replay, set[str]()
    if not (replay or spaces.continuous_numbers):
        found |= {"policy.distribution", *_OF_GAUSSIANS}
    encoded = encoded_spaces(policy, spaces.observations)
    others = [each for each in encoded.values() if not (isinstance(each, ArraySpace) and each.is_image)]
    by_images = len(encoded) == 1 and policy.encoder != "auto"  # an array of any shape is read as an image
    if not (replay or policy.encoder in ("mlp", "grid") or is_own(policy.encoder)):
        found |= {"policy.hidden", "policy.activation"} if by_images or not others else set()
    normalizing = policy.model_copy(update={"normalize_observations": True})
    if not normalized_components(normalizing, spaces.observations):
        found.add("policy.normalize_observations")
    return found


def unmeasured_target(spec: RunSpec) -> str:
    """Return why nothing in a run can show that its target is reached, or an empty string."""
    true_task, target = spec.trains_true_task, spec.training.target_return
    if target is not None and not true_task and spec.evaluation.seconds is None:
        return (
            f"training.target_return is {target:g}, but training plays another task (environment.training_kwargs, "
            "environment.no_reward_limit or lessons), whose returns say nothing about the target: set "
            "evaluation.seconds, such as 30, or training.target_return=none"
        )
    league = spec.league
    opponent, shares = league.target_opponent, league.opponents
    of_training = league.past + sum(shares.values()) if opponent is None else shares[opponent]
    counts = league.rating_share > 0.0 or (league.rating_actions == "sampled" and of_training > 0.0)
    if counts or (opponent is None and league.target_rating is None):
        return ""
    return f"the target is {spec.target}, but no match counts for it: set league.rating_share above 0, such as 0.01" + (
        ", or a share of the matches in league.opponents" if league.rating_actions == "sampled" else ""
    )


def _plain(path: str, value: Any, depth: int = 0) -> Any:
    """Return an argument of a constructor as files and messages express it. Raises SettingsError if they cannot."""
    if type(value).__module__ == "numpy" and getattr(value, "shape", None) == ():  # a scalar
        value = value.item()
    if depth > _MOST_NESTED:
        raise SettingsError(f"setting {path[:200]} is nested too deeply")
    if isinstance(value, list):
        return [_plain(f"{path}.{index}", part, depth + 1) for index, part in enumerate(value)]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        if value.keys() == {_NONE} and value[_NONE] is True:
            return None
        return {key: _plain(f"{path}.{key}", part, depth + 1) for key, part in value.items()}
    if value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    shown = " ".join(repr(value).split())
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    raise SettingsError(
        f"setting {path} is {shown}, which config.toml and messages to actors cannot express: {_instead(value)}"
    )


def _instead(value: Any) -> str:
    """Return how to write a value that is none of JSON's."""
    if isinstance(value, tuple | set | frozenset):
        return f"write a list, {list(value)}"
    if isinstance(value, datetime.date | datetime.time):
        return f'write a text, "{value.isoformat()}"'
    if isinstance(value, Path):
        return f'write a text, "{value}"'
    if hasattr(value, "tolist"):
        return "write a list, as by its method tolist()"
    if isinstance(value, dict):
        return "write its keys as texts"
    if isinstance(value, float):
        return "write a finite number, or a text that the constructor reads"
    return "write a number, a text in quotation marks, true, false, a list or a table"


def as_toml(values: Any) -> Any:
    """Return settings as TOML expresses them: {none = true} in place of None. See run_spec, which reads them."""
    if isinstance(values, dict):
        return {key: as_toml(value) for key, value in values.items()}
    if isinstance(values, list):
        return [as_toml(value) for value in values]
    return {_NONE: True} if values is None else values


def check_rollout_length(spec: RunSpec, spaces: Spaces) -> None:
    """Raise SettingsError if no row would have the mask of the next one, which action values bootstrap with."""
    if spec.algorithm.heads == "action_values" and spaces.masks and spec.collection.rollout_length < 2:
        raise SettingsError(
            f"collection.rollout_length is 1, but {spec.training.algorithm} needs the mask of the next row, and the "
            "actions of this environment are masked: make it at least 2"
        )
