"""The files of the page, as the package has them."""

import importlib.resources
from typing import NamedTuple

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


class Asset(NamedTuple):
    """One file."""

    content: bytes
    media_type: str


def read_assets() -> dict[str, Asset]:
    """Return the files of gateway/page by name."""
    found = {}
    for entry in importlib.resources.files("daedalus.gateway").joinpath("page").iterdir():
        media_type = _TYPES.get("." + entry.name.rpartition(".")[2])
        if media_type is not None:
            found[entry.name] = Asset(entry.read_bytes(), media_type)
    return found
