"""How a process opens its transport. This file chooses Zenoh; all others know only the interface."""

import logging
import threading
import time
from concurrent.futures import Future
from functools import partial

from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.transport.credentials import Credentials
from daedalus.transport.interface import RefusedError, Transport, TransportError, UnreachableError
from daedalus.transport.slow_calls import SlowCall
from daedalus.transport.zenoh_transport import connect, listen

__all__ = ["connect", "connect_until_interrupted", "connect_with_retry", "listen"]

_logger = logging.getLogger(__name__)

_FIRST_PAUSE_SECONDS, _MAX_PAUSE_SECONDS = 0.02, 1.0  # between attempts


class _StoppedError(Exception):
    pass


def connect_until_interrupted(endpoints: list[str], credentials: Credentials | None = None) -> Transport:
    """Connect once, for a command without handlers of signals: Ctrl-C raises KeyboardInterrupt at once.

    Zenoh itself waits up to 10 s for a host that does not answer. Raises as `connect` does.
    """
    return SlowCall(partial(connect, endpoints, credentials)).wait(lambda: None)


def connect_with_retry(
    endpoints: list[str],
    stop: threading.Event,
    timeout: float | None = None,
    credentials: Credentials | None = None,
    *,
    max_message_bytes: int = LEARNER_LIMITS.message_bytes,
) -> Transport | None:
    """Retry `connect` until it succeeds, and log once that it waits; return None if `stop` is set first.

    Raises UnreachableError after `timeout` seconds, and RefusedError at once.
    """

    def check() -> None:
        if stop.is_set():
            raise _StoppedError

    deadline = None if timeout is None else time.monotonic() + timeout
    pause, logged = _FIRST_PAUSE_SECONDS, False
    while True:
        attempt = SlowCall(partial(connect, endpoints, credentials, max_message_bytes=max_message_bytes))
        try:
            return attempt.wait(check)
        except _StoppedError:
            attempt.result.add_done_callback(_close)
            return None
        except RefusedError:
            raise
        except TransportError as error:
            if deadline is not None and time.monotonic() > deadline:
                raise UnreachableError(
                    f"{error} (for {timeout:g} s): is the learner running, and is this its address?"
                ) from None
            if not logged and pause >= _MAX_PAUSE_SECONDS / 2:
                _logger.info("%s; waiting for it", error)
                logged = True
        if stop.wait(pause):
            return None
        pause = min(2 * pause, _MAX_PAUSE_SECONDS)


def _close(attempt: Future[Transport]) -> None:
    """Close a transport that was opened when nobody waited for it any more."""
    if attempt.exception() is None:
        attempt.result().close()
