"""An address that only processes of this user can reach, for a run on one machine.

On loopback every user of the machine could connect, publish snapshots, and send rollouts.
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from daedalus.transport.addresses import is_socket_path, socket_address

_NAME = "learner"


@contextmanager
def private_address() -> Iterator[str]:
    """Return the address of a Unix socket in a new folder with mode 0700, which is removed at the end."""
    with tempfile.TemporaryDirectory(prefix="daedalus-", dir=_parent(), ignore_cleanup_errors=True) as folder:
        yield socket_address(os.path.join(folder, _NAME))


def _parent() -> str:
    """Return the folder for temporary files, or /tmp where the path of a socket would be too long."""
    chosen = os.path.abspath(tempfile.gettempdir())
    longest = os.path.join(chosen, "daedalus-12345678", _NAME)
    return chosen if is_socket_path(longest) else "/tmp"
