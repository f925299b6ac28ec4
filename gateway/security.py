"""Who may use a gateway: origins of pages, names of hosts, tokens; and the headers that bind the gateway's own page.

Tokens of clients and operators are valid by the file that `daedalus certs` writes. It is read again when it changes.
"""

import hashlib
import hmac
import json
import os
import re
import secrets
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.gateway.client_messages import ClientError
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

    def check_operator(self, token: str) -> str:
        """Return the owner of an operator's token, for a person. Raises ClientError if it is no such token."""
        self._read()
        operators = {name: entry for name, entry in self._tokens.items() if name.startswith(OPERATOR)}
        refusal = "this needs an operator's token (daedalus certs issue operator NAME)"
        return f"operator {self._check_among(operators, token, refusal).removeprefix(OPERATOR)}"

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

    def check_operator(self, token: str) -> str:
        """Return the owner of the token, for a person. Raises ClientError if this is not the token."""
        if not hmac.compare_digest(self._digest, digest(token)):
            raise ClientError("refused", "this is not the operator's token: it is in the file of --operator-token")
        return "the operator"


MESSAGES_PER_SECOND, MESSAGES_BURST = 1000.0, 2000.0


class RateLimit:
    """A bucket of permissions that fills at a constant rate."""

    def __init__(self, rate: float = MESSAGES_PER_SECOND, burst: float = MESSAGES_BURST) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._at = burst, 0.0

    def take(self, now: float) -> float:
        """Take one permission at a monotonic time; return the seconds to wait before it may be used."""
        self._left = min(self._left + (now - self._at) * self._rate, self._burst) - 1.0
        self._at = now
        return max(-self._left, 0.0) / self._rate


LOOPBACK = ("localhost", "127.0.0.1", "[::1]")
HEADERS = {
    # The page has no inline script or style, and loads nothing from other hosts.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Guard:
    """The rules of one gateway."""

    hosts: frozenset[str]  # in the Host header, with the port: another name may point here to reach this machine
    origins: frozenset[str]  # of pages that may connect, such as `http://127.0.0.1:8080`
    tokens: Tokens | None  # None: on loopback clients need no token
    operator: OperatorToken | None = None  # of a gateway without `tokens`: pages need it to read, too
    reads_openly: bool = True  # without any of them: whether pages may read what everybody may ask the learner

    def refusal(self, headers: Iterable[tuple[bytes, bytes]]) -> str:
        """Return why a request is refused, or an empty string.

        A browser sends the Origin of the page that connects. Programs send none.
        """
        found = {name.lower(): value.decode("latin-1") for name, value in headers}
        host, origin = found.get(b"host", "").lower(), found.get(b"origin")
        if host not in self.hosts:
            return f"this gateway does not serve the host {ascii(host)[:80]}: add it with --host"
        if origin is not None and origin.lower() not in self.origins:
            return f"pages of {ascii(origin)[:80]} may not connect: allow them with --allow-origin"
        return ""

    def check_token(self, name: str, token: str) -> str:
        """Return the owner of a client's token, empty if it needs none. Raises ClientError if it needs another."""
        return "" if self.tokens is None else self.tokens.check(name, token)

    def check_viewer(self, token: str) -> str:
        """Return the owner of a page's token, empty if reading needs none. Raises ClientError if it needs another."""
        if self.tokens is not None:
            return self.tokens.check_viewer(token)
        if self.operator is not None:
            self.operator.check_operator(token)
            return OPERATOR
        if not self.reads_openly:
            reason = "this gateway shows the run to operators only: start it with --operator-token FILE"
            raise ClientError("refused", reason)
        return ""

    @property
    def takes_orders(self) -> bool:
        """Whether there is any token with which a page may give orders."""
        return self.tokens is not None or self.operator is not None

    def check_operator(self, token: str) -> str:
        """Return the owner of a token, for a person. Raises ClientError unless a page may give orders with it."""
        tokens = self.tokens or self.operator
        if tokens is None:
            raise ClientError("refused", "this gateway takes no orders: start it with --operator-token FILE")
        return tokens.check_operator(token)


def guard(
    names: Iterable[str],
    port: int,
    allowed: Iterable[str],
    tokens: Tokens | None,
    operator: OperatorToken | None = None,
    *,
    reads_openly: bool = True,
) -> Guard:
    """Return the rules of a gateway.

    Args:
      names: under which it is reached, IPv6 addresses in brackets.
      port: where it listens.
      allowed: further origins.
      tokens: of the clients; with them the gateway uses TLS.
      operator: the token for reading and orders of a gateway without `tokens`.
      reads_openly: see Guard.
    """
    scheme, default = ("https", 443) if tokens is not None else ("http", 80)
    hosts = {f"{name.lower()}:{port}" for name in names}
    if port == default:
        hosts |= {name.lower() for name in names}
    origins = {f"{scheme}://{host}" for host in hosts} | {origin.lower().rstrip("/") for origin in allowed}
    return Guard(
        hosts=frozenset(hosts),
        origins=frozenset(origins),
        tokens=tokens,
        operator=operator,
        reads_openly=reads_openly,
    )
