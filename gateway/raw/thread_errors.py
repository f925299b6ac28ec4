"""Python's error for a thread that the system does not allow, as an error of one client."""

import contextlib
from collections.abc import Iterator

from daedalus.gateway.raw.packets import PacketError


@contextlib.contextmanager
def thread_errors() -> Iterator[None]:
    """Raise PacketError where the body cannot start a thread: it ends one connection, not the gateway."""
    try:
        yield
    except RuntimeError as error:
        if "can't start new thread" not in str(error):
            raise
        raise PacketError("the gateway has too many threads: try again later") from None
