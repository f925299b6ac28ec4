"""How a process opens its transport. This file chooses Zenoh; all others know only the interface."""

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.transport.credentials import Credentials
from daedalus.transport.interface import RefusedError, Transport, TransportError, UnreachableError
from daedalus.transport.slow_calls import SlowCall
from daedalus.transport.zenoh_session import no_answer
from daedalus.transport.zenoh_transport import connect, listen

__all__ = ["connect", "connect_once", "connect_with_retry", "listen"]

_logger = logging.getLogger(__name__)

_FIRST_PAUSE_SECONDS, _MAX_PAUSE_SECONDS = 0.02, 1.0  # between attempts
_QUIET_SECONDS = 1.0  # of failed attempts, before a line says so: processes that start together wait for each other
_SILENT_SECONDS = 3.0  # of an attempt without a result, before a line says what to check; Zenoh needs 10 s to fail
_ONCE_SECONDS = 5.0  # for a command that tries once
_GRACE_SECONDS = 0.7  # after a time limit, for an attempt that knows a better reason than silence


class _StoppedError(Exception):
    pass


def connect_once(
    endpoints: list[str], credentials: Credentials | None = None, timeout: float | None = None
) -> Transport:
    """Connect within `timeout` seconds, at most 5. Ctrl-C raises KeyboardInterrupt at once.

    For a command without handlers of signals: Zenoh itself waits up to 10 s for a host that does not answer.
    Raises UnreachableError after this time, and as `connect` does.
    """
    limit = _ONCE_SECONDS if timeout is None else min(timeout, _ONCE_SECONDS)
    deadline = time.monotonic() + limit + _GRACE_SECONDS

    def check() -> None:
        if time.monotonic() > deadline:
            raise UnreachableError(f"{no_answer(endpoints)} (tried for {limit:g} s)")

    return _open(SlowCall(partial(connect, endpoints, credentials)), check)


def connect_with_retry(
    endpoints: list[str],
    stop: threading.Event,
    timeout: float | None = None,
    credentials: Credentials | None = None,
    *,
    max_message_bytes: int = LEARNER_LIMITS.message_bytes,
) -> Transport | None:
    """Retry `connect` until it succeeds, and log what it waits for; return None if `stop` is set first.

    Raises UnreachableError after `timeout` seconds, also if an attempt is in progress, and RefusedError at once.
    """
    began = attempt_began = time.monotonic()
    deadline = None if timeout is None else began + timeout
    pause, reason, logged = _FIRST_PAUSE_SECONDS, "", ""

    def check() -> None:
        nonlocal reason
        if stop.is_set():
            raise _StoppedError
        now = time.monotonic()
        if not reason and now > attempt_began + _SILENT_SECONDS:
            reason = no_answer(endpoints)  # until the attempt has failed, and knows more
            log()
        if deadline is not None and now > deadline + (0.0 if reason else _GRACE_SECONDS):
            raise UnreachableError(f"{reason or no_answer(endpoints)} (tried for {timeout:g} s)")

    def log() -> None:
        nonlocal logged
        if reason != logged and time.monotonic() > began + _QUIET_SECONDS:
            _logger.info("%s; waiting for it", reason)
            logged = reason

    while True:
        attempt_began = time.monotonic()
        attempt = SlowCall(partial(connect, endpoints, credentials, max_message_bytes=max_message_bytes))
        try:
            return _open(attempt, check)
        except _StoppedError:
            return None
        except (RefusedError, UnreachableError):
            raise
        except TransportError as error:
            reason = str(error)
        log()
        if deadline is not None and time.monotonic() > deadline:
            raise UnreachableError(f"{reason} (tried for {timeout:g} s)")
        if stop.wait(pause):
            return None
        pause = min(2 * pause, _MAX_PAUSE_SECONDS)


def _open(attempt: SlowCall[Transport], check: Callable[[], object]) -> Transport:
    """Return the transport of an attempt. If `check` ends the wait, a transport that is opened later is closed."""
    try:
        return attempt.wait(check)
    except BaseException:  # also Ctrl-C
        attempt.result.add_done_callback(_close)
        raise


def _close(attempt: Future[Transport]) -> None:
    """Close a transport that was opened when nobody waited for it any more."""
    if attempt.exception() is None:
        attempt.result().close()
