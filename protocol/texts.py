"""Texts for a person who reads them: those from outside, printable or bounded, and numbers. Pure functions.

Outside are peers, and whoever has sent a run directory: names, reasons, paths and errors. A terminal obeys control
characters; others reorder a line, hide in it or end it. `str.isprintable` knows them all, also those to come: controls,
formats such as the marks of direction and the tags, separators other than the space, halves of characters that stand
for the bytes of a file's name, and what Unicode has not assigned. Whatever reaches a terminal, a log or a file goes
through one of these functions.
"""

import os
import re
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from urllib.parse import quote, unquote, urlsplit

HIDDEN = "***"
_SHORTEST = 6  # characters of a value of the process environment: shorter ones are in ordinary words
# No pattern begins with a repetition: a line of 64 KiB without a space must not take seconds.
_WORDS = r"(?:api_?-?key|access_?-?key|private_?-?key|token|passw(?:or)?d|passphrase|pwd|secret|credential)s?(?![a-z])"
_SECRET_NAME = re.compile(_WORDS, re.IGNORECASE)
_OF_URL = re.compile(r"(?<=://)[^\s/?#\"'<>]+@")  # the user's name may be a token
_ASSIGNED = re.compile(
    rf"((?:{_WORDS}[\w.-]{{0,40}}|[?&;](?:key|auth|sig|signature))[\"']?=[\"']?)[^\s\"'&;,<>#]+", re.IGNORECASE
)
_SAID = re.compile(
    r"((?:api[ _-]?key|password|passphrase|secret|(?:access|auth|bearer)[ _-]?token)[\"']?:[ \t]{0,8}[\"']?)"
    r"[^\s\"',;}]+",
    re.IGNORECASE,
)
_HEADER = re.compile(
    r"(\b(?:authorization[\"']?[ \t]{0,8}[:=][ \t]{0,8}[\"']?(?:bearer |basic |token )?|bearer ))[\w.~+/=-]{8,}",
    re.IGNORECASE,
)
_KNOWN = re.compile(r"\b(?:hf_|ghp_|gho_|github_pat_|wandb_v1_|sk-|glpat-)[\w-]{16,}")
_HINTS = re.compile(r"[:=_-]|bearer", re.IGNORECASE)  # without any of them no pattern fits


def without_secrets(text: str) -> str:
    """Return a text with passwords and tokens as `***`.

    Hidden are: user and password of an address, parameters of a query and assignments whose names are those of secrets,
    authorization headers, tokens in known forms, and the values of the process environment under such names, such as
    WANDB_API_KEY, or the password in MLFLOW_TRACKING_URI, wherever they stand.
    """
    for value in _environment_secrets():
        text = text.replace(value, HIDDEN)
    if _HINTS.search(text) is None:
        return text
    text = _OF_URL.sub(f"{HIDDEN}@", text)
    for pattern in (_ASSIGNED, _SAID, _HEADER):
        text = pattern.sub(rf"\g<1>{HIDDEN}", text)
    return _KNOWN.sub(HIDDEN, text)


def is_secret(name: str, value: str) -> bool:
    """Return whether a setting of this name holds a password or a token."""
    return _is_secret_name(name) or without_secrets(value) != value


@lru_cache(1024)  # the names of the process environment are the same for each line that is logged
def _is_secret_name(name: str) -> bool:
    return _SECRET_NAME.search(name) is not None


def _environment_secrets() -> list[str]:
    """Return the secrets of the process environment, the longest first."""
    found: set[str] = set()
    for name in os.environ:
        value = os.environ.get(name, "")  # not of `items`: another thread may remove it meanwhile
        if _is_secret_name(name):
            found.add(value)
        elif "@" in value and "://" in value:
            try:
                password = urlsplit(value).password or ""
            except ValueError:  # no address
                continue
            found |= {password, unquote(password), quote(unquote(password), safe="")}
    # The value of TOKEN_FILE=/run/secrets/token is a path, and that of TOKENIZERS_PARALLELISM a word.
    secrets = (each for each in found if len(each) >= _SHORTEST and not each.startswith(("/", ".")))
    return sorted((each for each in secrets if not each.isalpha()), key=len, reverse=True)


def utc(seconds: float) -> str:
    """Return a time, in seconds since 1970, in ISO 8601 with milliseconds, such as 2026-11-22T10:15:00.250Z."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


MAX_NAME, MAX_TEXT = 64, 300  # bytes in UTF-8: of a name, and of a reason or an event
MAX_ANSWER_TEXT = 1000  # bytes in UTF-8: of the reason in an answer to this process


def printable(text: str) -> str:
    """Return a text without secrets, and with every character that is not printable escaped but newlines and tabs."""
    text = without_secrets(text)
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() or character in "\n\t" else _escaped(character) for character in text
    )


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def one_line(text: str) -> str:
    """Return a text in one line, printable."""
    return printable(" ".join(text.split()))


def bounded_text(text: str, most: int = MAX_TEXT) -> str:
    """Return a foreign text in one line, without secrets and unprintable characters, cut to `most` bytes in UTF-8.

    An unprintable character becomes a space, and several spaces become one. Whatever a peer sends, a learner can then
    keep the text, log it, and report it within the limits of its readers, which count bytes.
    """
    start = without_secrets(text[: 4 * most])[:most]
    printable = "".join(character if character.isprintable() else " " for character in start)
    return " ".join(printable.split()).encode()[:most].decode(errors="ignore")


def listed(names: Sequence[object], most: int = 6) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return ", ".join(map(str, names[:most])) + more


def aligned(rows: Sequence[Sequence[str]], right: Collection[int] = ()) -> list[str]:
    """Return the rows of a table as lines. `right` are the columns of numbers, counted from 0, which end flush."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.rjust(width) if at in right else cell.ljust(width)
            for at, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def short_number(value: float) -> str:
    """Return a number of any size with at least three digits that count: 1,234,567, 987.1, 0.982 or 1.2e-05."""
    if abs(value) >= 1e15 or abs(value) < 10.0:
        return f"{value or 0.0:.3g}"
    return f"{value:,.0f}" if abs(value) >= 1e5 else f"{value:.1f}"


def short_rate(value: float) -> str:
    """Return a rate that is seen to be above 0 however small it is: 12,345, 42, 0.48 or 0.0098."""
    return f"{value:,.0f}" if value >= 9.95 else f"{value:.2g}"


def short_share(value: float) -> str:
    """Return a share as a whole percentage that is 0% or 100% only of none or all: 97%, <1%, >99%."""
    if 0.0 < value < 0.005:
        return "<1%"
    return ">99%" if 0.995 <= value < 1.0 else f"{value:.0%}"


def short_duration(seconds: float) -> str:
    """Return a duration with two digits that count, or more: 102 s, 1.5 s, 305 ms or 0.42 ms."""
    if seconds >= 9.95:
        return f"{seconds:,.0f} s"
    if seconds >= 0.995:
        return f"{seconds:.1f} s"
    return f"{seconds * 1000:.0f} ms" if seconds >= 0.00995 else f"{seconds * 1000:.2g} ms"


def policy_lag(updates: float, updates_per_batch: int) -> str:
    """Return a policy lag as `1 batch (160 updates)`, or as `0.8 updates` where a batch makes one update."""
    if updates_per_batch == 1:
        return _counted(updates, "update", "updates")
    return f"{_counted(updates / updates_per_batch, 'batch', 'batches')} ({_counted(updates, 'update', 'updates')})"


def _counted(count: float, one: str, several: str) -> str:
    text = f"{count:,.1f}".removesuffix(".0")
    return f"{text} {one if text == '1' else several}"


def exact_number(value: float | None) -> str:
    """Return the shortest text that is read as the same number: 475, 1000001, 2e-05 or 16777217.5; empty for None."""
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else repr(float(value)).removesuffix(".0")


def mebibytes(*sizes: int) -> list[str]:
    """Return sizes, in bytes, in MiB: with as many decimals as it takes to tell different ones apart, and from 0."""
    for decimals in range(20):
        texts = [f"{size / 2**20:,.{decimals}f}" for size in sizes]
        if len({f"{0.0:.{decimals}f}", *texts}) == len({0, *sizes}):
            return texts
    return [f"{size / 2**20:,.20f}" for size in sizes]  # exact
