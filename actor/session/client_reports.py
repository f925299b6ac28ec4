"""Sends what a client counts about itself to the learner, for the status. No threads, no waiting."""

import time
from collections.abc import Callable

from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import ClientReport
from daedalus.transport.interface import QuerySender, TransportError

_PAUSE_SECONDS = 2.0  # between two reports
_ANSWER_SECONDS = 5.0


class ClientReports:
    """The reports of one client to one learner after the other."""

    def __init__(self, sender: QuerySender, report: Callable[[], ClientReport]) -> None:
        """`report` returns the counts so far."""
        self._sender, self._report = sender, report
        self._sent: ClientReport | None = None
        self._next_at = 0.0

    def begin(self) -> None:
        """Begin with another learner, which knows no counts."""
        self._sent, self._next_at = None, 0.0

    def send_if_due(self, run: str) -> None:
        """Send the counts if they have changed since the last report, and that was a while ago."""
        now = time.monotonic()
        if now < self._next_at:
            return
        self._next_at = now + _PAUSE_SECONDS
        report = self._report()
        if report != self._sent:
            self.send(run, report)

    def send(self, run: str, report: ClientReport) -> None:
        """Send a report. One that is lost is sent again later."""
        self._sent = report
        try:
            self._sender.query_async(
                keys.reports(run, report.actor),
                encode(report),
                timeout=_ANSWER_SECONDS,
                on_answer=self._on_answer,
            )
        except TransportError:
            self._sent = None

    def _on_answer(self, data: bytes | None) -> None:
        if data is None:
            self._sent = None
