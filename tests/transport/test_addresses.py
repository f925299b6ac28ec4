"""transport/addresses.py: which addresses are allowed."""

import pytest

from daedalus.transport.addresses import AddressError, check_connecting, check_listening


@pytest.mark.parametrize("address", ["tcp/127.0.0.1:7447", "tcp/127.8.9.1:1", "tcp/localhost:7447", "tcp/[::1]:7447"])
def test_loopback_needs_no_certificates(address: str) -> None:
    check_listening([address], tls=False, insecure=False)
    check_listening([address], tls=True, insecure=False)


@pytest.mark.parametrize("address", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.1:7447", "tcp/gpu-box:7447"])
def test_listening_beyond_loopback_needs_certificates_or_insecure(address: str) -> None:
    for tls, hint in ((False, "use certificates"), (True, "listen on tls/")):
        with pytest.raises(AddressError, match=f"{hint}.*--insecure"):
            check_listening(["tcp/127.0.0.1:1", address], tls=tls, insecure=False)
    check_listening([address], tls=False, insecure=True)
    check_listening([address.replace("tcp/", "tls/")], tls=True, insecure=False)


def test_protocol_must_fit_the_use_of_certificates() -> None:
    with pytest.raises(AddressError, match="needs certificates"):
        check_listening(["tls/127.0.0.1:1"], tls=False, insecure=True)
    with pytest.raises(AddressError, match="needs certificates"):
        check_connecting(["tls/h:1"], tls=False)
    with pytest.raises(AddressError, match="must begin with tls/"):
        check_connecting(["tcp/h:1"], tls=True)
    check_connecting(["tls/h:1", "tls/i:2"], tls=True)
    check_connecting(["tcp/h:1"], tls=False)


MALFORMED = ("", "h:1", "udp/h:1", "tcp/h", "tcp/:1", "tcp/h:x", "tcp/h:65536", "tls//h:-1")


@pytest.mark.parametrize(
    ("address", "message"),
    [
        *((address, r"is not an address: write tcp/HOST:PORT") for address in MALFORMED),
        ("tcp/127.0.0.1:0", "^tcp/127.0.0.1:0 has port 0: choose a port from 1 to 65535"),
        ("tls/h:00", "^tls/h:00 has port 0: choose a port from 1 to 65535"),
    ],
)
def test_address_that_cannot_be_used_is_refused_in_one_line(address: str, message: str) -> None:
    for check in (
        lambda: check_listening([address], tls=True, insecure=True),
        lambda: check_connecting([address], tls=address.startswith("tls")),
    ):
        with pytest.raises(AddressError, match=message):
            check()
