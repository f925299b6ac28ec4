"""The tokens of clients: which are valid, by the file that `daedalus certs` writes. Reads that file when it changes."""

import hashlib
import hmac
import json
import re
import secrets
import time
from pathlib import Path
from typing import Any

from daedalus.gateway.errors import ClientError

TOKENS = "tokens.json"  # in the folder of a gateway: {NAME: {"sha256": HEX, "expires": SECONDS_SINCE_1970}}
_MAX_FILE_BYTES = 16 << 20


def new_token() -> str:
    """Return a token that nobody can guess."""
    return secrets.token_urlsafe(32)


def digest(token: str) -> str:
    """Return what is kept of a token."""
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()


class Tokens:
    """The tokens in a gateway's folder."""

    def __init__(self, directory: Path) -> None:
        """Raise OSError or ValueError if the file is missing or damaged."""
        self._path = directory / TOKENS
        self._read_at: tuple[int, int] = (0, 0)
        self._tokens: dict[str, tuple[str, float]] = {}
        self._read_if_changed()

    def check(self, name: str, token: str) -> None:
        """Raise ClientError unless the token is that of this name, or of the name before its first dot."""
        try:
            self._read_if_changed()
        except (OSError, ValueError):
            raise ClientError("unavailable", "the gateway cannot read its tokens: tell its operator") from None
        known, expires = self._tokens.get(name) or self._tokens.get(name.partition(".")[0]) or ("", 0.0)
        if not hmac.compare_digest(known, digest(token)):
            raise ClientError(
                "refused",
                "the token is not one of this name: the operator issues one with `daedalus certs issue client NAME`",
            )
        if time.time() > expires:
            raise ClientError("refused", "the token has expired: the operator renews it with `daedalus certs renew`")

    def _read_if_changed(self) -> None:
        state = self._path.stat()
        stamp = (state.st_mtime_ns, state.st_ino)
        if stamp == self._read_at:
            return
        if state.st_size > _MAX_FILE_BYTES:
            raise ValueError(f"{self._path} is too large")
        self._tokens = _parsed(json.loads(self._path.read_text("utf-8")))
        self._read_at = stamp


def _parsed(content: Any) -> dict[str, tuple[str, float]]:
    if not isinstance(content, dict):
        raise ValueError("the tokens are not a map")
    tokens = {}
    for name, entry in content.items():
        match entry:
            case {"sha256": str(known), "expires": int() | float() as expires} if re.fullmatch("[0-9a-f]{64}", known):
                tokens[name] = known, float(expires)
            case _:
                raise ValueError(f"the token of {name!a} is damaged")
    return tokens
