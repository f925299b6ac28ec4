"""Checks of network addresses: traffic that others can reach must be encrypted and authenticated.

tcp/HOST:PORT                everybody who can reach the address; on loopback, every user of this machine
tls/HOST:PORT                holders of certificates
unixsock-stream/PATH         a Unix socket: processes that may enter its folder
"""

import ipaddress
import os
import socket
import stat
from collections.abc import Sequence
from contextlib import suppress

_SOCKET = "unixsock-stream"
_MAX_PATH_BYTES = 98  # a socket's path has at most 104 bytes on macOS (108 on Linux), and Zenoh appends ".lock"


class AddressError(Exception):
    """An address that is malformed or not allowed; the message says what to do."""


def check_listening(endpoints: list[str], *, tls: bool, insecure: bool) -> None:
    """Raise AddressError for a malformed address, or one where unauthenticated processes could connect.

    Args:
      endpoints: see above.
      tls: whether the process has a certificate.
      insecure: whether the user allows plain TCP beyond loopback.
    """
    for endpoint in endpoints:
        protocol, host = _parts(endpoint)
        if protocol == _SOCKET:
            _check_folder(endpoint, os.path.dirname(host))
        if protocol == "tls" and not tls:
            raise AddressError(f"{endpoint} needs certificates: --tls DIR (create them with daedalus certs)")
        if protocol == "tcp" and not insecure and not is_loopback(host):
            secure = f"listen on tls/{endpoint.partition('/')[2]}" if tls else "use certificates (--tls DIR)"
            raise AddressError(
                f"{endpoint} is unencrypted and open to every host that can reach it: {secure}, "
                "listen on tcp/127.0.0.1:PORT, or add --insecure on a network that you trust"
            )


def check_connecting(endpoints: list[str], *, tls: bool) -> None:
    """Raise AddressError for a malformed address, or one whose protocol does not fit the use of certificates."""
    for endpoint in endpoints:
        protocol, _ = _parts(endpoint)
        if protocol == "tls" and not tls:
            raise AddressError(f"{endpoint} needs certificates: --tls DIR")
        if protocol != "tls" and tls:
            raise AddressError(f"{endpoint} is not a TLS address: with --tls the address must begin with tls/")


def socket_path(endpoint: str) -> str | None:
    """Return the path of a Unix socket's address, or None for another address."""
    protocol, _, path = endpoint.partition("/")
    return path if protocol == _SOCKET else None


def socket_address(path: str) -> str:
    """Return the address of a Unix socket."""
    return f"{_SOCKET}/{path}"


def is_socket_path(path: str) -> bool:
    """Return whether a Unix socket can have this path. In an address, `?` and `#` would end it."""
    return path.startswith("/") and len(os.fsencode(path)) <= _MAX_PATH_BYTES and not {*path} & {*"?#"}


def _parts(endpoint: str) -> tuple[str, str]:
    """Return the protocol, and the host or path."""
    protocol, slash, rest = endpoint.partition("/")
    if protocol == _SOCKET:
        if not is_socket_path(rest):
            raise AddressError(
                f"{endpoint!r} is not an address: write {_SOCKET}/PATH with an absolute path of at most "
                f"{_MAX_PATH_BYTES} bytes, without ? and #"
            )
        return protocol, rest
    host, colon, port = rest.rpartition(":")
    known = protocol in ("tcp", "tls")
    if not slash or not known or not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise AddressError(f"{endpoint!r} is not an address: write tcp/HOST:PORT or tls/HOST:PORT")
    if not int(port):
        raise AddressError(f"{endpoint} has port 0: choose a port from 1 to 65535, which other processes then name")
    return protocol, host.strip("[]")


def _check_folder(endpoint: str, folder: str) -> None:
    """Raise AddressError if other users may enter the folder of a socket."""
    try:
        found = os.stat(folder)
    except OSError as error:
        raise AddressError(f"{endpoint}: {folder}: {error.strerror}") from None
    if not hasattr(os, "geteuid"):  # Windows
        raise AddressError(f"{endpoint}: this system has no such sockets: write tcp/HOST:PORT or tls/HOST:PORT")
    if found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) & 0o077:
        raise AddressError(f"{endpoint} is open to other users of this machine: its folder must be yours and mode 700")


def is_loopback(host: str) -> bool:
    """Return whether a host name or address is that of this host alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


# Of the documentation's network (RFC 5737): a UDP socket that is connected to it sends nothing.
_ELSEWHERE = ("192.0.2.1", 9)


def reachable(endpoints: Sequence[str], certificate_hosts: Sequence[str] = ()) -> list[str]:
    """Return addresses to connect to, for each address that a process listens on.

    An unspecified host, such as 0.0.0.0, stands for every interface of this host, and nobody can connect to it.

    Args:
      endpoints: addresses such as tcp/0.0.0.0:7447.
      certificate_hosts: names and addresses in the listener's certificate; actors accept no others.
    """
    found: list[str] = []
    for endpoint in endpoints:
        protocol, _, rest = endpoint.partition("/")
        host, _, port = rest.rpartition(":")
        if _is_unspecified(host.strip("[]")):
            found += [f"{protocol}/{bracketed(each)}:{port}" for each in _hosts(certificate_hosts)]
        else:
            found.append(endpoint)
    return list(dict.fromkeys(found))


def _hosts(certificate_hosts: Sequence[str]) -> list[str]:
    elsewhere = [host for host in certificate_hosts if not is_loopback(host)]
    return elsewhere or list(certificate_hosts) or [socket.gethostname(), *_own_address()]


def _own_address() -> list[str]:
    """Return the address of the interface towards other networks, if there is one."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(_ELSEWHERE)
        return [probe.getsockname()[0]]
    return []


def _is_unspecified(host: str) -> bool:
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_unspecified
    return False


def bracketed(host: str) -> str:
    """Return a host as it stands before a port: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host
