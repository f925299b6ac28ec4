"""Test that Zenoh does not wait for the other end when it closes a connection."""

import os
import socket
import struct
from contextlib import suppress
from pathlib import Path

import pytest
from certificates import make_certificates
from processes import until

from daedalus.transport.credentials import load
from daedalus.transport.zenoh_transport import connect, listen

PAIR = struct.Struct("ii")


def lingering() -> int:
    """Return the number of sockets of this process whose close() waits for the other end."""
    count = 0
    for entry in os.listdir("/dev/fd"):
        try:
            found = socket.socket(fileno=int(entry))
        except OSError:  # not a socket, or the descriptor of the folder itself
            continue
        with suppress(OSError):  # closed meanwhile
            count += PAIR.unpack(found.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, PAIR.size))[0]
        found.detach()
    return count


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_both_ends_close_a_connection_without_waiting(address: str, protocol: str, tmp_path: Path) -> None:
    server = client = None
    if protocol == "tls":
        folder, address = make_certificates(tmp_path / "certs"), address.replace("tcp/", "tls/")
        server, client = load(folder / "router", "router"), load(folder / "learner", "learner")
    router = listen([address], credentials=server)
    clients = [connect([address], client)]
    try:
        until(lambda: not lingering())
        clients += [connect([address], client), connect([address], client)]  # after the router's own declarations
        until(lambda: not lingering())
    finally:
        for transport in (*clients, router):
            transport.close()
