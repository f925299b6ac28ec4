"""The tokens of clients and operators: which are valid, by the file that `daedalus certs` writes.

The file is read again when it changes.
"""

import hashlib
import hmac
import json
import os
import re
import secrets
import time
from pathlib import Path
from typing import Any

from daedalus.gateway.errors import ClientError
from daedalus.policy.saving.regular_files import read_regular

# In the folder of a gateway: {NAME: {"sha256": HEX, "expires": SECONDS_SINCE_1970}}; of an operator OPERATOR + NAME.
TOKENS = "tokens.json"
OPERATOR = "operator:"  # no name of a client has a colon
_MAX_FILE_BYTES = 16 << 20
_MIN_TOKEN, _MAX_TOKEN = 16, 256  # characters


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

    def check(self, name: str, token: str) -> str:
        """Return the owner of a client's token: the client's name, or what is before its first dot.

        Raises ClientError if the token is another's.
        """
        self._read()
        owner = name if name in self._tokens else name.partition(".")[0]
        known, expires = self._tokens.get(owner, ("", 0.0))
        if not hmac.compare_digest(known, digest(token)):
            raise ClientError(
                "refused",
                "the token is not one of this name: the operator issues one with `daedalus certs issue client NAME`",
            )
        _check_expiry(expires)
        return owner

    def check_viewer(self, token: str) -> str:
        """Return the owner of the token of any client or operator. Raises ClientError if it is no such token."""
        self._read()
        return self._check_among(self._tokens, token, "the page needs a token: of a client, or of an operator")

    def check_operator(self, token: str) -> None:
        """Raise ClientError unless the token is that of an operator."""
        self._read()
        operators = {name: entry for name, entry in self._tokens.items() if name.startswith(OPERATOR)}
        self._check_among(operators, token, "this needs an operator's token (daedalus certs issue operator NAME)")

    def _check_among(self, tokens: dict[str, tuple[str, float]], token: str, refusal: str) -> str:
        given = digest(token)
        found = [(expires, owner) for owner, (known, expires) in tokens.items() if hmac.compare_digest(known, given)]
        if not found:
            raise ClientError("refused", refusal)
        expires, owner = max(found)
        _check_expiry(expires)
        return owner

    def _read(self) -> None:
        try:
            self._read_if_changed()
        except (OSError, ValueError):
            raise ClientError("unavailable", "the gateway cannot read its tokens: tell its operator") from None

    def _read_if_changed(self) -> None:
        state = self._path.stat()
        stamp = (state.st_mtime_ns, state.st_ino)
        if stamp == self._read_at:
            return
        if state.st_size > _MAX_FILE_BYTES:
            raise ValueError(f"{self._path} is too large")
        self._tokens = _parsed(json.loads(self._path.read_text("utf-8")))
        self._read_at = stamp


def _check_expiry(expires: float) -> None:
    if time.time() > expires:
        raise ClientError("refused", "the token has expired: the operator renews it with `daedalus certs renew`")


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


class OperatorToken:
    """The operator's token of a gateway without certificates, in a file that only its owner may read."""

    def __init__(self, path: Path) -> None:
        """Read the file; write a new token first if there is no file. Raises OSError or ValueError."""
        try:
            with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
                file.write(new_token() + "\n")
        except FileExistsError:
            pass
        token = read_regular(path, _MAX_TOKEN + 1).decode("ascii").strip()
        if not _MIN_TOKEN <= len(token) <= _MAX_TOKEN:
            raise ValueError(f"{path} has no token of {_MIN_TOKEN} to {_MAX_TOKEN} characters: delete the file")
        self._digest = digest(token)

    def check_operator(self, token: str) -> None:
        """Raise ClientError unless this is the token."""
        if not hmac.compare_digest(self._digest, digest(token)):
            raise ClientError("refused", "this is not the operator's token: it is in the file of --operator-token")
