"""The waits of a standing process between attempts that fail for causes which somebody else can remove."""

import logging
import random
import threading
import time

_logger = logging.getLogger(__name__)

_FIRST_PAUSE_SECONDS, _MAX_PAUSE_SECONDS = 1.0, 30.0  # doubles; a fleet finds a run that can be played within this time
_FIRST_LOG_SECONDS, _MAX_LOG_SECONDS = 60.0, 3600.0  # between lines about the same cause; doubles
_LASTED_SECONDS = 60.0  # an attempt that lasted for longer had not failed at once


class Retries:
    """Attempts of one process. For one thread."""

    def __init__(self, stop: threading.Event) -> None:
        """`stop` ends a wait."""
        self._stop = stop
        self._random = random.Random()  # not the module's generator: environments may seed it alike on all hosts
        self._pause = _FIRST_PAUSE_SECONDS
        self._began = time.monotonic()  # the present attempt
        self._cause, self._failures = "", 0  # of the last failures in a row
        self._log_pause = self._log_at = 0.0

    def wait(self, cause: str) -> bool:
        """Wait after a failed attempt, longer after each in a row; return whether the process was stopped.

        Logs the cause at once if it is another one than before, and else at growing intervals.
        """
        now = time.monotonic()
        if now > self._began + _LASTED_SECONDS:
            self._pause = _FIRST_PAUSE_SECONDS
        if cause != self._cause:
            self._cause, self._failures, self._log_pause = cause, 0, _FIRST_LOG_SECONDS
            _logger.warning("%s; trying again, at most every %g s", cause, _MAX_PAUSE_SECONDS)
            self._log_at = now + self._log_pause
        self._failures += 1
        if now >= self._log_at:
            self._log_pause = min(2 * self._log_pause, _MAX_LOG_SECONDS)
            self._log_at = now + self._log_pause
            _logger.warning("%s; %d attempts have failed so far", cause, self._failures)
        pause, self._pause = self._pause, min(2 * self._pause, _MAX_PAUSE_SECONDS)
        stopped = self._stop.wait(pause * self._random.uniform(0.5, 1.0))  # a fleet must not come back as one
        self._began = time.monotonic()
        return stopped

    def succeeded(self) -> None:
        """Forget the failures before a success."""
        self._pause, self._cause, self._began = _FIRST_PAUSE_SECONDS, "", time.monotonic()
