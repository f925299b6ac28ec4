"""Which addresses may be listened on: beyond loopback only where traffic is encrypted and authenticated. Pure."""

import ipaddress

_PROTOCOLS = ("tcp", "tls")


class AddressError(Exception):
    """An address that cannot be used so; the message says what to do."""


def check_listening(endpoints: list[str], *, tls: bool, insecure: bool) -> None:
    """Raises AddressError for an address that is none, or that would open the service to strangers."""
    for endpoint in endpoints:
        protocol, host = _parts(endpoint)
        if protocol == "tls" and not tls:
            raise AddressError(f"{endpoint} needs certificates: --tls DIR (daedalus certs makes them)")
        if protocol == "tcp" and not insecure and not _is_loopback(host):
            instead = f"listen on tls/{endpoint.partition('/')[2]}" if tls else "give it certificates (--tls DIR)"
            raise AddressError(
                f"whoever reaches {endpoint} could take part, unseen and unchecked: {instead}, "
                "listen on tcp/127.0.0.1:PORT, or say --insecure where the network is all your own"
            )


def check_connecting(endpoints: list[str], *, tls: bool) -> None:
    """Raises AddressError for an address that is none, or where certificates and protocol do not go together."""
    for endpoint in endpoints:
        protocol, _ = _parts(endpoint)
        if protocol == "tls" and not tls:
            raise AddressError(f"{endpoint} needs certificates: --tls DIR")
        if protocol == "tcp" and tls:
            raise AddressError(f"{endpoint} takes no certificates: with --tls the address begins with tls/")


def _parts(endpoint: str) -> tuple[str, str]:
    protocol, slash, rest = endpoint.partition("/")
    host, colon, port = rest.rpartition(":")
    if not slash or protocol not in _PROTOCOLS or not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise AddressError(f"{endpoint!r} is no address: it must be like tcp/HOST:PORT or tls/HOST:PORT")
    return protocol, host.strip("[]")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
