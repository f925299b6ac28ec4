"""The full rollouts of clients on their way to the learner, sent on a thread of its own.

The event loop never waits. Zenoh makes a sender wait while the link is congested.
"""

import asyncio
import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from daedalus.actor.session.conversation import Query
from daedalus.actor.session.uploading import ACTOR_PAUSE_SECONDS, Reports, Uploads
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import ClientReport, Join, Welcome
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.interface import Transport, TransportError

_MAX_FULL_ROLLOUTS = 8  # that wait for room in the window; beyond that the oldest is dropped


class ClientUploads:
    """What one client sends, to one learner epoch after the other."""

    def __init__(
        self,
        join: Join,
        sender: "Sender",
        on_heard: Callable[[float], None],
        on_rollout: Callable[["ClientUploads"], None],
    ) -> None:
        """Construct the uploads.

        Args:
          join: names the actor and its incarnation.
          sender: sends the rollouts, until they are acknowledged, and the reports.
          on_heard: called with the time of each message of the learner.
          on_rollout: called when a rollout can be sent, by `send_one`.
        """
        self._join, self._sender, self._on_rollout = join, sender, on_rollout
        self._uploads = Uploads(join.actor, on_heard)
        self._reports = Reports(self._report)
        self._session: Welcome | None = None
        self._full: deque[Rollout] = deque(maxlen=_MAX_FULL_ROLLOUTS)
        self._sequence = 0  # of the next rollout
        self._dropped = 0  # rollouts that were never sent
        self.rows = self.overridden_actions = 0  # for the status
        self._sent_at = 0.0  # the last rollout

    def begin(self, session: Welcome) -> None:
        """Send to a learner epoch that has no rollouts of this client; those for an earlier one are dropped."""
        self._uploads.begin(session.run, session.spec.collection.window)
        self._session, self._sequence = session, 0
        self._full.clear()
        self._reports.begin()

    def resume(self) -> None:
        """Go on with the same learner epoch after the network failed."""
        with self._sender.lock:
            self._uploads.resume()

    def keep(self, rollout: Rollout) -> None:
        """Send a rollout once there is room in the window."""
        self._dropped += len(self._full) == _MAX_FULL_ROLLOUTS
        self._full.append(rollout)
        if self.can_send:
            self._on_rollout(self)

    @property
    def can_send(self) -> bool:
        """Whether there is a rollout, and room for it in the window."""
        return bool(self._full) and self._uploads.in_flight.has_room

    def send_one(self) -> None:
        """Encode and send the oldest full rollout, if it can be sent."""
        session = self._session
        if session is None or not self.can_send:
            return
        identity = RolloutIdentity(
            actor=self._join.actor,
            incarnation=self._join.incarnation,
            sequence=self._sequence,
            learner_epoch=session.learner_epoch,
        )
        payload = encode(replace(self._full.popleft(), identity=identity))
        with self._sender.lock:
            self._uploads.in_flight.add(self._sequence, payload)
        self._sequence += 1
        self._sent_at = time.monotonic()
        self._send_rollouts()

    def send_due(self) -> None:
        """Send again what is due, and report what the status shows of the client."""
        if self._uploads.in_flight.rollouts:
            self._send_rollouts()
        now = time.monotonic()
        is_slow = now > self._sent_at + ACTOR_PAUSE_SECONDS  # of others, the rollouts are signs of life
        if self._session is not None and (self.overridden_actions or self._dropped or is_slow):
            for query in self._reports.take_due(self._session.run, now):
                self._sender.send(query)

    def _send_rollouts(self) -> None:
        with self._sender.lock:
            queries = self._uploads.take_due(time.monotonic())
        for query in queries:
            self._sender.send(query)

    def _report(self) -> ClientReport:
        return ClientReport(
            actor=self._join.actor,
            incarnation=self._join.incarnation,
            rows=self.rows,
            overridden_actions=self.overridden_actions,
            rollouts_dropped=self._dropped,
        )

    @property
    def newest_version(self) -> int:
        """The newest policy version that an acknowledgement mentioned."""
        return self._uploads.in_flight.newest_version

    @property
    def ended_by(self) -> tuple[str, str]:
        """The verdict that ended the session, and the reason; both empty while it goes on."""
        return self._uploads.in_flight.ended_by, self._uploads.in_flight.reason


class Outbox:
    """The clients that have a rollout to send.

    Encoding takes longer than the choice of an action, and clients that began together fill their rollouts together. So
    each turn of the event loop encodes one rollout for the Sender, and answers clients between them.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._ready: dict[ClientUploads, None] = {}  # in the order in which they are sent

    def add(self, uploads: ClientUploads) -> None:
        """Send the rollouts of a client, soon."""
        if not self._ready:
            self._loop.call_soon(self._send_one)
        self._ready[uploads] = None

    def _send_one(self) -> None:
        uploads = next(iter(self._ready))
        del self._ready[uploads]
        uploads.send_one()
        if uploads.can_send:
            self._ready[uploads] = None
        if self._ready:
            self._loop.call_soon(self._send_one)


_MAX_QUERIES = 1 << 17  # that wait for the thread: the windows of 2,048 clients, with 64 rollouts each
_POLL_SECONDS = 0.2  # how soon the thread notices `close` if the queue was full


class Sender:
    """A queue of queries, which the thread sends in the order of the calls.

    Attributes:
      lock: is held while an answer is received, on the transport's threads. Hold it to change what answers change.
    """

    def __init__(self, transport: Transport, on_failure: Callable[[Exception], None]) -> None:
        """Construct the sender.

        Args:
          transport: the network; the caller closes it, after the sender.
          on_failure: called on the thread with an error of ours, which ends it.
        """
        self._transport, self._on_failure = transport, on_failure
        self._queue: queue.Queue[Query | None] = queue.Queue(_MAX_QUERIES)
        self._closed = threading.Event()
        self.lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="sender", daemon=True)

    def open(self) -> None:
        """Begin to send."""
        self._thread.start()

    def close(self, timeout: float) -> None:
        """Send what waits, for at most `timeout` seconds, and refuse further queries. Idempotent."""
        self._closed.set()
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)  # wakes the thread
        if self._thread.is_alive():
            self._thread.join(timeout)

    def send(self, query: Query) -> None:
        """Send a query, soon. Without room for it, or after `close`, there is no answer."""
        try:
            if not self._closed.is_set():
                self._queue.put_nowait(query)
                return
        except queue.Full:
            pass
        self._answer(query, None)

    def _run(self) -> None:
        try:
            while not (self._closed.is_set() and self._queue.empty()):
                with contextlib.suppress(queue.Empty):
                    self._send(self._queue.get(timeout=_POLL_SECONDS))
        except Exception as error:  # broad: any error of ours ends the gateway
            self._on_failure(error)

    def _send(self, query: Query | None) -> None:
        if query is None:
            return
        try:
            self._transport.query_async(
                query.key, query.payload, timeout=query.timeout, on_answer=lambda data: self._answer(query, data)
            )
        except TransportError:
            self._answer(query, None)

    def _answer(self, query: Query, data: bytes | None) -> None:
        with self.lock:
            query.on_answer(data, time.monotonic())
