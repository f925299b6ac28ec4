"""pip's configuration of this machine, for an image: which options to write there and which files to copy there."""

import ast
import re
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

# pip splits the values of these options at white space.
_LISTS = {"constraint", "extra-index-url", "find-links", "requirement", "trusted-host"}
_INDEXES = {"extra-index-url", "index-url"}
_PATHS = {"cert", "client-cert", "constraint", "find-links", "requirement"}
_SECTIONS = ("global", "install", ":env:")  # for `pip install`, each goes before those to its left
_LINK_OUTSIDE = re.compile(r'href="(\.\./\.\./|/|file:)')  # from a page DIR/PROJECT/index.html


def options_of(listing: str) -> dict[str, str]:
    """Return the options of `pip install` from the output of `pip config list`."""
    found = [re.fullmatch(r"([^=]+)\.([\w-]+)=('.*'|\".*\")", line) for line in listing.splitlines()]
    settings = [(match[1], match[2], ast.literal_eval(match[3])) for match in found if match]
    return {
        name: value for wanted in _SECTIONS for section, name, value in settings if section == wanted
    }  # a later section replaces the value of an earlier one


def for_image(options: Mapping[str, str]) -> tuple[dict[str, str], list[Path]]:
    """Return the options for an image, and the files and folders of this machine to copy there to the same paths.

    An option, or a word of a list, is left out if it names a file or folder that does not exist. So is an index in a
    local folder if its pages link to files outside the folder: pip would fail on these links.
    """
    kept: dict[str, str] = {}
    copied: list[Path] = []
    for name, value in options.items():
        words = []
        for word in value.split() if name in _LISTS else [value]:
            path = _local_path(name, word)
            if path is None:
                words.append(word)
            elif path.exists() and not (name in _INDEXES and _links_outside(path)):
                words.append(word if word.startswith("file:") else str(path))
                copied.append(path)
        if words:
            kept[name] = " ".join(words)
    return kept, list(dict.fromkeys(copied))


def _local_path(name: str, word: str) -> Path | None:
    """Return the path that a word of an option names, or None if it names no file of this machine."""
    if word.startswith("file:"):
        return Path(url2pathname(urlsplit(word).path))
    if name in _PATHS and "://" not in word:
        return Path(word).expanduser().absolute()
    return None


def _links_outside(index: Path) -> bool:
    page = next(index.glob("*/index.html"), None)
    return page is not None and _LINK_OUTSIDE.search(page.read_text("utf-8", errors="replace")) is not None
