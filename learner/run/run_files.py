"""Files of a run directory, read with limits. Nothing in them is trusted: they may come from another machine.

Values are limited in depth and size too, so that others can compare and print them.
"""

import json
import os
import re
import tomllib
from pathlib import Path
from typing import Any

from daedalus.policy.saving.regular_files import open_regular, read_regular
from daedalus.protocol.texts import without_secrets

_MAX_JSON_BYTES, MAX_TOML_BYTES = 32 << 20, 1 << 20
_MAX_DEPTH = 64  # of lists and maps within each other; Python's recursion limit is not far above
_LARGEST_INTEGER = 2**64  # Python refuses to print integers of many digits
# More names than that with dots between them. tomllib takes hours for a name of 1 MiB.
_DEEP_NAME = re.compile(rf"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){{{_MAX_DEPTH}}}""")


class RunDataError(Exception):
    """Error for a run directory that cannot be used. The message is one line."""


def read_file(path: Path, limit: int) -> bytes | None:
    """Return the content of a file, or None without the file.

    Raises RunDataError if it is no regular file, has more than `limit` bytes or cannot be read.
    """
    try:
        content = read_regular(path, limit + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RunDataError(f"{path}: {error.strerror}") from None
    if len(content) > limit:
        raise RunDataError(f"{path} is larger than {limit >> 20} MiB, the limit for such a file of a run")
    return content


def read_end(path: Path, most_bytes: int) -> str:
    """Return the last whole lines of a text without secrets; empty for a link, or what cannot be read.

    A link could lead to any file of the reader's. A line that would be cut is left out: without the name before it, a
    secret is not known as one.
    """
    if path.is_symlink():
        return ""
    try:
        with open_regular(path) as file:
            begin = max(os.fstat(file.fileno()).st_size - most_bytes, 0)
            file.seek(begin)
            text = file.read(most_bytes).decode("utf-8", "replace")
    except OSError:
        return ""
    return without_secrets((text.partition("\n")[2] if begin else text).strip())


def read_json(path: Path) -> dict[str, Any] | None:
    """Return the content of a JSON file, or None without the file. Raises RunDataError."""
    content = read_file(path, _MAX_JSON_BYTES)
    if content is None:
        return None
    try:
        values = json.loads(content.decode())
    except (ValueError, RecursionError):
        raise RunDataError(f"{path} is damaged: it is not valid JSON; delete the file") from None
    if not isinstance(values, dict):
        raise RunDataError(f"{path} is damaged: it is not a JSON object; delete the file")
    _check_values(values, path)
    return values


def read_toml(path: Path) -> dict[str, Any] | None:
    """Return the content of a TOML file, or None without the file. Raises RunDataError."""
    content = read_file(path, MAX_TOML_BYTES)
    if content is None:
        return None
    try:
        text = content.decode("utf-8-sig")  # some editors of Windows begin a file with a mark
        if _DEEP_NAME.search(text):
            raise RecursionError
        values = tomllib.loads(text)
    except RecursionError:
        raise RunDataError(f"{path} is not valid: its values are nested too deeply") from None
    except ValueError as error:
        raise RunDataError(f"{path} is not valid TOML: {error}") from None
    _check_values(values, path)
    return values


def _check_values(values: dict[str, Any], path: Path) -> None:
    """Raise RunDataError for values that are nested too deeply, and for integers that are too large."""
    level: list[Any] = [values]
    for _ in range(_MAX_DEPTH):
        if any(isinstance(value, int) and abs(value) > _LARGEST_INTEGER for value in level):
            raise RunDataError(f"{path} is not valid: it has an integer of more than 64 bits")
        level = [
            child
            for value in level
            if isinstance(value, dict | list)
            for child in (value.values() if isinstance(value, dict) else value)
        ]
    if level:
        raise RunDataError(f"{path} is not valid: its values are nested too deeply")
