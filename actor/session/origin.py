"""Where this actor runs, for the operator who reads the status."""

import importlib.metadata
import socket

from daedalus.protocol.messages import Origin
from daedalus.transport.interface import Transport

_DISTRIBUTION = "daedalus-rl"


def own_origin(transport: Transport) -> Origin:
    """Return the name of this host, the version of this software and the address of this end of the connection."""
    try:
        version = importlib.metadata.version(_DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:  # the source code without an installation
        version = "unknown"
    return Origin(host=socket.gethostname(), software=f"{_DISTRIBUTION} {version}", address=transport.local_address)
