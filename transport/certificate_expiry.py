"""When certificates are valid, and warnings before they expire.

Validity       from when to when, with what to say about it: pure
ExpiryWatch    a thread that warns, in every process that uses a certificate
"""

import functools
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

WARNING_DAYS = 30  # before a certificate expires

_logger = logging.getLogger(__name__)

_DAY, _HOUR = 86_400.0, 3600.0
_POLL_SECONDS = 60.0  # a certificate may be replaced at any time
_MIN_PAUSE_SECONDS, _MAX_PAUSE_SECONDS = _HOUR, _DAY  # between two warnings


@dataclass(frozen=True, slots=True)
class Validity:
    """From when to when a certificate is valid, in seconds since 1970."""

    begins: float
    ends: float

    def days_left(self) -> float:
        """Return the days until it expires by the clock of this host; negative if it has expired."""
        return (self.ends - time.time()) / _DAY

    @property
    def warns_from(self) -> float:
        """The time from which users are warned: in the last 30 days, or the last third of a short-lived certificate."""
        return self.ends - min(WARNING_DAYS * _DAY, (self.ends - self.begins) / 3)

    def period(self) -> str:
        """Return the period of validity, and the time of this host's clock."""
        return f"from {_minute(self.begins)} to {_minute(self.ends)}; now {_minute(time.time())}"

    def fault(self) -> str:
        """Return why it is not valid now, with both causes; an empty text if it is valid.

        The text continues a sentence about the certificate.
        """
        now = time.time()
        if now < self.begins:
            return (
                f"is not valid before {_minute(self.begins)}, and the clock of this host says {_minute(now)}: correct "
                "this clock, or that of the host that issued the certificate"
            )
        if now > self.ends:
            return (
                f"expired on {_minute(self.ends)}, and the clock of this host says {_minute(now)}: renew it "
                "(daedalus certs renew), or correct the clock if it is wrong"
            )
        return ""

    def warning(self) -> str:
        """Return what to say now of a certificate that has expired or soon will; an empty text if there is nothing."""
        now = time.time()
        if fault := self.fault():
            return fault
        if now < self.warns_from:
            return ""
        return f"expires in {_duration(self.ends - now)}, on {_minute(self.ends)}: renew it (daedalus certs renew)"

    def pause(self) -> float:
        """Return the seconds from one warning to the next: a quarter of what is left, from an hour to a day."""
        return min(max((self.ends - time.time()) / 4, _MIN_PAUSE_SECONDS), _MAX_PAUSE_SECONDS)


def _minute(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(seconds))


def _duration(seconds: float) -> str:
    for unit, name in ((_DAY, "days"), (_HOUR, "hours"), (60.0, "minutes")):
        if seconds >= 2 * unit:
            return f"{int(seconds / unit)} {name}"
    return f"{int(seconds)} seconds"


class ExpiryWatch:
    """Warnings about the certificates of this process. Has its own thread, which never ends."""

    def __init__(self) -> None:
        self._watched: dict[Path, _Watched] = {}
        self._changed = threading.Condition()
        threading.Thread(target=self._watch, name="certificate expiry", daemon=True).start()

    def add(self, directory: Path, read: Callable[[], Validity | None]) -> None:
        """Warn now and from now on. `read` returns the validity of the certificate that is in the folder then."""
        with self._changed:
            if directory in self._watched:
                return
            self._watched[directory] = watched = _Watched(directory, read)
            watched.look()
            self._changed.notify()

    def _watch(self) -> None:
        with self._changed:
            while True:
                nexts = [watched.look() for watched in self._watched.values()]
                self._changed.wait(min(nexts, default=_POLL_SECONDS))


class _Watched:
    def __init__(self, directory: Path, read: Callable[[], Validity | None]) -> None:
        self._directory, self._read = directory, read
        self._known: Validity | None = None
        self._kind = ""  # the first word of the last warning: it expires, or has expired
        self._next = 0.0  # monotonic time of the next warning

    def look(self) -> float:
        """Warn if it is time to; return the seconds until the next look."""
        validity = self._read()
        if validity is None:  # a file is being replaced
            return _POLL_SECONDS
        if validity != self._known:
            self._known, self._kind = validity, ""
        warning, now = validity.warning(), time.monotonic()
        kind = warning.partition(" ")[0]
        if warning and (kind != self._kind or now >= self._next):
            _logger.warning("the certificate in %s %s", self._directory, warning)
            self._next = now + validity.pause()
        self._kind = kind
        changes = [each - time.time() for each in (validity.warns_from, validity.ends) if each > time.time()]
        return min([*changes, max(self._next - now, 0.1) if warning else _POLL_SECONDS, _POLL_SECONDS]) + 0.05


@functools.cache
def expiry_watch() -> ExpiryWatch:
    """Return the one of this process."""
    return ExpiryWatch()
