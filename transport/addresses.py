"""Checks of network addresses: traffic beyond loopback must be encrypted and authenticated. Pure functions."""

import ipaddress

_PROTOCOLS = ("tcp", "tls")


class AddressError(Exception):
    """An address that is malformed or not allowed; the message says what to do."""


def check_listening(endpoints: list[str], *, tls: bool, insecure: bool) -> None:
    """Raise AddressError for a malformed address, or one where unauthenticated processes could connect.

    Args:
      endpoints: `tcp/HOST:PORT` or `tls/HOST:PORT`.
      tls: whether the process has a certificate.
      insecure: whether the user allows plain TCP beyond loopback.
    """
    for endpoint in endpoints:
        protocol, host = _parts(endpoint)
        if protocol == "tls" and not tls:
            raise AddressError(f"{endpoint} needs certificates: --tls DIR (create them with daedalus certs)")
        if protocol == "tcp" and not insecure and not _is_loopback(host):
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
        if protocol == "tcp" and tls:
            raise AddressError(f"{endpoint} is not a TLS address: with --tls the address must begin with tls/")


def _parts(endpoint: str) -> tuple[str, str]:
    protocol, slash, rest = endpoint.partition("/")
    host, colon, port = rest.rpartition(":")
    if not slash or protocol not in _PROTOCOLS or not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise AddressError(f"{endpoint!r} is not an address: write tcp/HOST:PORT or tls/HOST:PORT")
    return protocol, host.strip("[]")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
