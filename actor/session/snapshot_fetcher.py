"""Fetches whole snapshots on request, one at a time. State and requests, no threads and no waiting."""

import threading
import time
from collections.abc import Callable

from daedalus.actor.session.learner_queries import LearnerQueries
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Message, Snapshot, SnapshotRequest
from daedalus.transport.interface import Transport, TransportError

_ANSWER_SECONDS = 10.0  # the learner answers at once, but may drop the answer on a congested link


class SnapshotFetcher:
    """One actor's fetches from one learner epoch."""

    def __init__(
        self,
        transport: Transport,
        queries: LearnerQueries,
        run: str,
        actor: str,
        held_version: int,
        on_news: Callable[[], None],
    ) -> None:
        """`on_news` is called on the transport's threads when `take` has something new."""
        self._transport, self._queries, self._on_news = transport, queries, on_news
        self._key, self._actor, self._held_version = keys.snapshots(run), actor, held_version
        self._lock = threading.Lock()  # guards all below
        self._requested_at = 0.0
        self._fetching = False
        self._answer: bytes | None = None  # not taken yet
        self._seconds = 0.0
        self.answered_request_at = 0.0  # the monotonic time of the request that was answered last

    @property
    def requested_at(self) -> float:
        """The monotonic time of the last request."""
        return self._requested_at

    @property
    def seconds(self) -> float:
        """How long the last answer took."""
        return self._seconds

    @property
    def in_progress(self) -> bool:
        """Whether an answer is awaited."""
        return self._fetching

    def request_newest(self) -> None:
        """Request the newest snapshot, unless an answer is awaited."""
        with self._lock:
            if self._fetching:
                return
            self._fetching, self._requested_at = True, time.monotonic()
        request = SnapshotRequest(actor=self._actor, held_version=self._held_version, compact=False)
        try:
            self._transport.query_async(self._key, encode(request), timeout=_ANSWER_SECONDS, on_answer=self._on_answer)
        except TransportError:
            self._on_answer(None)

    def take(self) -> Message | None:
        """Return an answer of the learner that was not taken yet: a Snapshot, or another message."""
        with self._lock:
            answer, self._answer = self._answer, None
        message = None if answer is None else self._queries.decode(answer)
        if isinstance(message, Snapshot):
            self._held_version = message.policy_version
        return message

    def _on_answer(self, data: bytes | None) -> None:
        """Receive an answer, or None without one. Called on the transport's threads."""
        with self._lock:
            self._fetching = False
            if data is None:
                return
            self._answer, self._seconds = data, time.monotonic() - self._requested_at
            self.answered_request_at = self._requested_at
        self._on_news()
