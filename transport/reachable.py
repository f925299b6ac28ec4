"""Addresses by which other hosts reach a listener of this host."""

import ipaddress
import socket
from collections.abc import Sequence
from contextlib import suppress

from daedalus.transport.addresses import is_loopback

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
            found += [f"{protocol}/{_bracketed(each)}:{port}" for each in _hosts(certificate_hosts)]
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


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
