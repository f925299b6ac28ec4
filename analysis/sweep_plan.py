"""The runs of a sweep: the settings that vary, and the names and directories of its runs. No processes."""

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from daedalus.launch.run_choice import RunChoice
from daedalus.learner.run import run_directory
from daedalus.learner.run.setting_errors import types_of
from daedalus.learner.run.settings import SettingsError, flat_settings, read_value
from daedalus.policy.user_modules import allow_settings
from daedalus.protocol.spec import RunSpec

_PACKAGE = "environment.package"
_LOG_FACTOR = 10.0  # a range that spans more is sampled on a logarithmic scale
_DIGITS = r"\d+(?:_\d+)*"
_NUMBER = rf"[+-]?(?:{_DIGITS}\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """Values of a setting, as they are written after `=`."""

    key: str
    values: tuple[str, ...]

    @property
    def first(self) -> str:
        """The first value."""
        return self.values[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Range:
    """Range of a number, both ends included."""

    key: str
    low: float
    high: float
    whole: bool  # whether its values are integers

    @property
    def first(self) -> str:
        """The lowest value."""
        return self.written(self.low)

    @property
    def log(self) -> bool:
        """Whether it is sampled on a logarithmic scale."""
        return self.low > 0.0 and self.high / self.low > _LOG_FACTOR

    def written(self, value: float) -> str:
        """Return a value of the range, to a thousandth of the range or four digits, as it is written after `=`."""
        narrow = max(abs(self.low), abs(self.high)) / (self.high - self.low)  # a range from 1e6 to 1e6 + 1 needs more
        rounded = round(value) if self.whole else float(f"{value:.{4 + int(math.log10(max(narrow, 1.0)))}g}")
        bounded = min(max(rounded, self.low), self.high)
        return str(int(bounded)) if self.whole else repr(bounded)


Axis = Choices | Range


def read_axis(text: str) -> Axis:
    """Return the axis that `SECTION.KEY=VALUE,VALUE,...` or `SECTION.KEY=LOW..HIGH` describes. Raises SettingsError."""
    key, equals, rest = (part.strip() for part in text.partition("="))
    if not equals or not rest or "." not in key:
        raise SettingsError(f"--over {text}: write section.key=value,value, such as collection.rollout_length=5,20,64")
    if key == "training.seed":
        raise SettingsError("--over training.seed: use --seeds N for N seeds of each setting")
    if key == "environment.id":
        raise SettingsError("--over environment.id: a sweep has one environment: start a sweep for each")
    section = key.partition(".")[0]
    if section not in RunSpec.model_fields:
        raise SettingsError(f"--over {text}: there is no section {section!r}: write {', '.join(RunSpec.model_fields)}")
    ends = re.fullmatch(rf"({_NUMBER})\.\.({_NUMBER})", rest)
    if ends is not None:
        low, high = float(ends[1]), float(ends[2])
        if not (math.isfinite(low) and math.isfinite(high)):
            raise SettingsError(f"--over {text}: an end of the range is too large")
        if not low < high:
            raise SettingsError(f"--over {text}: the range is empty: write the lower end first")
        whole = float not in types_of(key.split("."))  # an argument of an environment has any type
        whole = whole and all(re.fullmatch(rf"[+-]?{_DIGITS}", end) for end in ends.groups())
        return Range(key=key, low=low, high=high, whole=whole)
    values = split_values(rest)
    if "" in values:
        raise SettingsError(f"--over {text}: a value is empty: remove the comma, or write a value")
    try:
        parsed = [(type(read), read) for read in (read_value(key, value) for value in values)]
    except SettingsError as error:
        raise SettingsError(f"--over {text}: {error}") from None
    twice = next((value for index, value in enumerate(values) if parsed[index] in parsed[:index]), None)
    if twice is not None:
        raise SettingsError(f"--over {text}: the value {twice} is there twice: remove one")
    return Choices(key=key, values=tuple(values))


def split_values(text: str) -> list[str]:
    """Return the parts between commas, except for commas inside brackets, braces and quotation marks."""
    parts, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        else:
            depth += (character in "[{(") - (character in "]})")
        if character == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts]


_LONGEST_NAME = 120

Point = Mapping[str, str]  # a value, as it is written after `=`, of each setting that the sweep varies


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedRun:
    """One run of a sweep."""

    name: str
    point: Point
    seed: int
    directory: Path
    spec: RunSpec
    words: tuple[str, ...] = field(repr=False)  # of the command line that starts it, after `daedalus`

    @property
    def resume_words(self) -> tuple[str, ...]:
        """Words of the command line that continues it, after `daedalus`."""
        return ("resume", str(self.directory), *allow_settings(self.spec.user_modules))

    @property
    def log(self) -> Path:
        """File for what the run prints."""
        return self.directory.parent / "logs" / f"{self.name}.log"


class Planner:
    """Planner of runs in one folder."""

    def __init__(
        self, choice: RunChoice, trackers: Sequence[str], folder: Path, defaults: dict[str, Any] | None = None
    ) -> None:
        """Construct the planner. See RunChoice.spec for `defaults`."""
        self._choice, self._trackers, self._folder, self._defaults = choice, trackers, folder, defaults

    def runs(self, name: str, point: Point, seeds: Sequence[int]) -> list[PlannedRun]:
        """Return the runs of a point, one for each seed.

        Raises SettingsError if its settings are invalid, or if a run has begun with other settings.
        """
        runs = []
        for seed in seeds:
            choice = _with_point(self._choice, point, seed)
            own = f"{name}_seed-{seed}" if name else f"seed-{seed}"
            directory = self._folder / own
            spec = choice.spec(self._defaults)
            if spec.evaluation.final_episodes == 0:
                raise SettingsError("evaluation.final_episodes: at least 1, as a sweep compares final evaluations")
            words = (*_words(choice, self._trackers), "--run-dir", str(directory))
            run = PlannedRun(name=own, point=point, seed=seed, directory=directory, spec=spec, words=words)
            _check_same(run)
            runs.append(run)
        return runs


def _with_point(choice: RunChoice, point: Point, seed: int) -> RunChoice:
    """Return the choice with the settings of a point."""
    assignments = (*choice.assignments, *(f"{key}={value}" for key, value in point.items()))
    return replace(choice, seed=seed, assignments=assignments)


def _words(choice: RunChoice, trackers: Sequence[str]) -> list[str]:
    words = ["train", *([choice.preset] if choice.preset is not None else [])]
    for name in ("env", "algorithm", "actors", "seed", "env_steps", "wrap"):
        value = getattr(choice, name)
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    words += [word for tracker in trackers for word in ("--log", tracker)]
    return [*words, *(word for assignment in choice.assignments for word in ("--set", assignment))]


def point_name(point: Point) -> str:
    """Return a name for a folder from the values of a point, different for different values."""
    parts = [f"{key.rpartition('.')[2]}-{_value_name(value)}" for key, value in point.items()]
    name = "_".join(parts)
    return name if len(name) <= _LONGEST_NAME else f"{name[:_LONGEST_NAME]}-{_digest(name)}"


def _value_name(value: str) -> str:
    """Return a value with characters that are safe in names; [64,64] becomes 64x64."""
    if re.fullmatch(r"[\w.+-]+", value):
        return value
    numbers = re.fullmatch(r"\[\s*([\d.e+-]+(?:\s*,\s*[\d.e+-]+)*)\s*\]", value)
    if numbers is not None:
        return "x".join(number.strip() for number in numbers[1].split(",")) + ("x" if "," not in value else "")
    return f"{re.sub(r'[^A-Za-z0-9]+', '-', value).strip('-')[:30]}-{_digest(value)}"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:6]


def is_done(run: PlannedRun) -> bool:
    """Return whether a run has ended and was evaluated. One with a damaged summary has not: it writes it again."""
    summary = run.directory / run_directory.SUMMARY
    if not has_begun(run) or not summary.exists():
        return False
    try:
        content = run_directory.read_json(summary)
    except SettingsError:
        return False
    return bool(content.get("finished")) and content.get("evaluation") is not None


def has_begun(run: PlannedRun) -> bool:
    """Return whether the directory of a run exists with its settings."""
    return (run.directory / run_directory.CONFIG).exists()


def _check_same(run: PlannedRun) -> None:
    """Check that a run that has begun has the settings that are planned for it. Raises SettingsError."""
    if not has_begun(run):
        return
    before, now = (_flat(spec) for spec in (run_directory.read_config(run.directory), run.spec))
    if now[_PACKAGE] is None:  # then the run has the one that was installed when it began
        now[_PACKAGE] = before.get(_PACKAGE)
    different = [key for key in {**now, **before} if before.get(key) != now.get(key)]  # [lessons] may have no setting
    if different:
        key = different[0]
        raise SettingsError(
            f"{run.directory} was begun with other settings ({key} is {before.get(key)}, and not {now.get(key)}): "
            "choose another --folder, or remove this one"
        )


def _flat(spec: RunSpec) -> dict[str, Any]:
    return flat_settings(spec.model_dump(mode="json", exclude={"training": {"algorithm_record"}}))
