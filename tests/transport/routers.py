"""Routers on a free address, for tests of the transport."""

from pathlib import Path
from typing import Any

from certificates import unchecked
from processes import free_address

from daedalus.transport.interface import AddressInUseError, Transport
from daedalus.transport.zenoh_transport import listen


def listen_somewhere(folder: Path | None = None, **options: Any) -> tuple[str, Transport]:
    """Return the address of a new router, and the router; with TLS if there is a folder of its certificate."""
    if folder is not None:
        options["credentials"] = unchecked(folder, "router", "")
    for _ in range(10):
        address = free_address() if folder is None else free_address().replace("tcp/", "tls/")
        try:
            return address, listen([address], **options)
        except AddressInUseError:  # another process took it meanwhile
            continue
    raise AssertionError("no free port")
