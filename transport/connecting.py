"""Waits for a router or learner that is not there yet: who starts first does not matter."""

import logging
import threading
import time

from daedalus.transport.credentials import Credentials
from daedalus.transport.interface import RefusedError, Transport, TransportError
from daedalus.transport.zenoh_transport import connect

_logger = logging.getLogger(__name__)

_FIRST_PAUSE_SECONDS, _MAX_PAUSE_SECONDS = 0.02, 1.0  # between attempts


def connect_with_retry(
    endpoints: list[str],
    stop: threading.Event,
    timeout: float | None = None,
    credentials: Credentials | None = None,
) -> Transport | None:
    """Tries to `connect` until something answers, and says once that it waits; None if told to stop first.

    Raises TransportError after `timeout` seconds, RefusedError at once.
    """
    deadline = None if timeout is None else time.monotonic() + timeout
    pause, told = _FIRST_PAUSE_SECONDS, False
    while True:
        try:
            return connect(endpoints, credentials)
        except RefusedError:
            raise
        except TransportError as error:
            if deadline is not None and time.monotonic() > deadline:
                raise TransportError(
                    f"{error} (for {timeout:g} s): is the learner running, and is the address its own?"
                ) from None
            if not told and pause >= _MAX_PAUSE_SECONDS / 2:
                _logger.info("%s; waiting for it", error)
                told = True
        if stop.wait(pause):
            return None
        pause = min(2 * pause, _MAX_PAUSE_SECONDS)
