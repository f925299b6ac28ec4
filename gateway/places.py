"""The places of a gateway's clients and pages: who holds how many, and who makes room."""

import contextlib
import ipaddress
import socket
import struct
from collections.abc import Callable, Iterator
from typing import Any

from daedalus.gateway.client_messages import ClientError

_MAX_CONNECTIONS = 2048
_OTHER_DESCRIPTORS = 256  # that are no connections of clients

_SOCK_DIAG, _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST = 4, 20, 1  # of Linux, as are the next
_HEADER, _ANY = struct.Struct("=IHHII"), 0xFFFFFFFF
_USER_AT = _HEADER.size + 4 + 48 + 12  # of the user in an answer: inet_diag_msg


def most_connections() -> int:
    """Return how many connections a gateway has at most: some of the descriptors are for the network and for files."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows has no limit
        return _MAX_CONNECTIONS
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if limit == resource.RLIM_INFINITY:
        return _MAX_CONNECTIONS
    return min(_MAX_CONNECTIONS, max(limit - _OTHER_DESCRIPTORS, limit // 2))


class Places:
    """A number of places. When all are taken, the owner with the most gives one to an owner with fewer."""

    def __init__(self, most: int, what: str, reserved: int = 0) -> None:
        """Construct the places.

        Args:
          most: the number of places.
          what: is counted, for messages.
          reserved: further places, for operators.
        """
        self._most, self._what, self._reserved = most, what, reserved
        self._held: dict[str, dict[object, Callable[[ClientError], None]]] = {}  # by owner, the oldest first

    @contextlib.contextmanager
    def take(self, owner: str, end: Callable[[ClientError], None], *, is_operator: bool = False) -> Iterator[None]:
        """Hold a place. Raises ClientError if there is none for this owner.

        Args:
          owner: whose share it counts towards.
          end: called if the place is given to another owner: it must end the connection soon.
          is_operator: whether the reserved places may be used.
        """
        if self.taken >= self._most + (self._reserved if is_operator else 0):
            self._displace(owner)
        place = object()
        self._held.setdefault(owner, {})[place] = end
        try:
            yield
        finally:
            self._give_back(owner, place)

    @property
    def taken(self) -> int:
        """How many places are taken."""
        return sum(map(len, self._held.values()))

    def _displace(self, owner: str) -> None:
        largest = max(self._held, key=lambda held: len(self._held[held]), default=owner)
        share = len(self._held.get(largest, ()))
        if len(self._held.get(owner, ())) + 1 >= share:
            raise ClientError("unavailable", f"{self._most} {self._what} are connected already: try again later")
        place, end = next(reversed(self._held[largest].items()))
        self._give_back(largest, place)
        end(ClientError("unavailable", f"all places are taken, {share} of them by this owner, and another needs one"))

    def _give_back(self, owner: str, place: object) -> None:
        held = self._held.get(owner, {})
        held.pop(place, None)
        if not held:
            self._held.pop(owner, None)


def peer_of(address: str, local: Any, remote: Any) -> str:
    """Return who is at the other end of a connection without a token: a user of this machine, or a network.

    Args:
      address: of the other end, as `network_of` takes it.
      local: the connection's own address, as sockets have it.
      remote: the same of the other end.
    """
    network = network_of(address)
    if network == "loopback" and (user := _user_of(local, remote)) is not None:
        return f"user {user}"
    return network


def network_of(address: str) -> str:
    """Return what counts as one address: whoever has an IPv6 address has all of its /64."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    parsed = getattr(parsed, "ipv4_mapped", None) or parsed
    if parsed.is_loopback:
        return "loopback"
    return str(parsed) if parsed.version == 4 else str(ipaddress.ip_network((parsed, 64), strict=False))


def _user_of(local: Any, remote: Any) -> int | None:
    """Return the user whose socket the other end of a connection on this machine is; None if that is unknown."""
    try:
        family = socket.AF_INET6 if ":" in remote[0] else socket.AF_INET
        ends = [socket.inet_pton(family, end[0]).ljust(16, b"\0") for end in (remote, local)]
        identity = struct.pack("!HH", remote[1], local[1]) + b"".join(ends) + struct.pack("=III", 0, _ANY, _ANY)
        request = struct.pack("=BBBBI", family, socket.IPPROTO_TCP, 0, 0, _ANY) + identity
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _SOCK_DIAG) as kernel:
            kernel.settimeout(0.1)
            header = _HEADER.pack(_HEADER.size + len(request), _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST, 0, 0)
            kernel.send(header + request)
            answer = kernel.recv(4096)
        if _HEADER.unpack_from(answer)[1] == _SOCK_DIAG_BY_FAMILY:
            return struct.unpack_from("=I", answer, _USER_AT)[0]
    except (OSError, AttributeError, struct.error):  # not on Linux, or not allowed here
        pass
    return None
