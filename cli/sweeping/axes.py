"""What `--over SECTION.KEY=...` says: a list of values, or a range. Pure functions."""

import math
import re
from dataclasses import dataclass

from daedalus.learner.run.settings import SettingsError, read_value
from daedalus.protocol.spec import RunSpec

_LOG_FACTOR = 10.0  # a range that spans more is sampled on a logarithmic scale
_DIGITS = r"\d+(?:_\d+)*"
_NUMBER = rf"[+-]?(?:{_DIGITS}\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """Values of a setting, as they are written after `=`."""

    key: str
    values: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Range:
    """Range of a number, both ends included."""

    key: str
    low: float
    high: float
    whole: bool  # whether the setting is an integer

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
        whole = all(re.fullmatch(rf"[+-]?{_DIGITS}", end) for end in ends.groups())
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
