"""transport/addresses.py: addresses that other hosts can connect to."""

import socket

import pytest

from daedalus.transport import addresses as module
from daedalus.transport.addresses import reachable


def test_an_address_of_a_host_stays_as_it_is() -> None:
    addresses = ["tcp/127.0.0.1:7447", "tls/gpu-box.lan:7447", "tcp/[::1]:7447", "unixsock-stream/tmp/x/y"]
    assert reachable(addresses) == addresses


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "0:0:0:0:0:0:0:0"])
def test_an_unspecified_address_is_replaced_by_the_name_and_the_address_of_this_host(
    host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_own_address", lambda: ["192.168.1.7"])
    assert reachable([f"tcp/{host}:7447"]) == [f"tcp/{socket.gethostname()}:7447", "tcp/192.168.1.7:7447"]


def test_with_a_certificate_only_its_hosts_are_named() -> None:
    hosts = ["localhost", "127.0.0.1", "gpu-box.lan", "2001:db8::7"]
    assert reachable(["tls/0.0.0.0:1", "tcp/127.0.0.1:1"], hosts) == [
        *("tls/gpu-box.lan:1", "tls/[2001:db8::7]:1", "tcp/127.0.0.1:1")
    ]
    assert reachable(["tls/0.0.0.0:1"], hosts[:2]) == ["tls/localhost:1", "tls/127.0.0.1:1"]


def test_this_host_has_an_address_or_no_network() -> None:
    assert all(socket.inet_aton(address) for address in module._own_address())
