"""Watches the folder of a listener's credentials, so that a revoked certificate is refused without a restart."""

import logging
import threading
from collections.abc import Callable

from daedalus.transport.credentials import (
    CA,
    CERTIFICATE,
    CLIENTS,
    KEY,
    Credentials,
    CredentialsError,
    authorised_names,
    load,
)

_POLL_SECONDS = 1.0

_logger = logging.getLogger(__name__)

_Stamp = tuple[tuple[int, int, int] | None, ...]  # inode, time of change and size of each file; None if it is missing


class CredentialsWatch:
    """Watch of one folder, from `open` to `close`. Has its own thread."""

    def __init__(self, credentials: Credentials, on_change: Callable[[], None]) -> None:
        """Construct the watch.

        Args:
          credentials: the folder, and the role that its certificate must have.
          on_change: called when the files have changed and are valid.
        """
        self._credentials, self._on_change = credentials, on_change
        self._used = self._seen = self._stamp()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="credentials watch", daemon=True)

    def open(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread. Does not wait for a change that is being applied."""
        self._closed.set()

    def _watch(self) -> None:
        while not self._closed.wait(_POLL_SECONDS):
            stamp = self._stamp()
            # Files that are still being copied differ from poll to poll.
            if stamp == self._seen and stamp != self._used:
                self._used = stamp
                self._apply()
            self._seen = stamp

    def _apply(self) -> None:
        folder = self._credentials.directory
        try:
            load(folder, self._credentials.role)
            names = authorised_names(folder)
        except CredentialsError as error:
            _logger.warning("the changed certificates are not used: %s", error)
            return
        self._on_change()
        _logger.info(
            "certificates in %s have changed: %d actors and %d operators are authorised; all connections are renewed",
            folder,
            len(names["actors"]),
            len(names["operators"]),
        )

    def _stamp(self) -> _Stamp:
        return tuple(map(self._stamp_of, (CA, CERTIFICATE, KEY, CLIENTS)))

    def _stamp_of(self, name: str) -> tuple[int, int, int] | None:
        try:
            found = (self._credentials.directory / name).stat()
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns, found.st_size
