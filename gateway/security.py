"""Who may use a gateway: origins of pages, names of hosts, tokens; and the headers that bind the gateway's own page."""

from collections.abc import Iterable
from dataclasses import dataclass

from daedalus.gateway.errors import ClientError
from daedalus.gateway.tokens import OPERATOR, OperatorToken, Tokens

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

    def check_operator(self, token: str) -> None:
        """Raise ClientError unless a page may give orders with this token."""
        tokens = self.tokens or self.operator
        if tokens is None:
            raise ClientError("refused", "this gateway takes no orders: start it with --operator-token FILE")
        tokens.check_operator(token)


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
