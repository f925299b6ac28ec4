"""What an actor and a learner say to each other while it plays: rollouts out, answers in, and every wait for either.

The transport's threads bring answers and news; the rest is for the actor's own thread.
"""

import threading
import time
from collections.abc import Callable

from daedalus.actor.session.in_flight_rollouts import Uploader
from daedalus.actor.session.learner_queries import ActorError, LearnerLostError, LearnerQueries, RunOverError
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Join
from daedalus.transport.interface import Transport, TransportError

_ANSWER_LIMITS = Limits(max_bytes=0, max_header_bytes=16 << 10, max_arrays=0)
_ACKNOWLEDGE_SECONDS = 30.0  # a saturated learner answers late
_HEARTBEAT_SECONDS = 0.2  # how soon a wait notices that it should stop
_SILENCE_SECONDS = 10.0  # nothing heard for so long, the learner is asked whether it is there


class UploadSession:
    """With one learner after the other."""

    def __init__(self, transport: Transport, link: LearnerQueries, stop: threading.Event) -> None:
        self._transport, self._link, self._stop = transport, link, stop
        self._changed = threading.Condition()  # guards what the transport's threads touch: the next three
        self._uploader = Uploader(window=1)
        self._learner_left = False
        self._heard_at = 0.0  # when the learner last said anything
        self._run, self._join = "", Join(actor="", incarnation=0)

    def found(self) -> None:
        """A learner has let the actor in; what is heard from now on counts."""
        with self._changed:
            self._learner_left, self._heard_at = False, time.monotonic()

    def begin(self, run: str, join: Join, window: int) -> None:
        """Begins with a learner that knows of nothing yet; up to `window` rollouts are under way to it."""
        with self._changed:
            self._run, self._join, self._uploader = run, join, Uploader(window)

    def resume(self) -> None:
        """Goes on with the same learner, after the network failed."""
        with self._changed:
            self._uploader.send_again()

    # ---------------------------------------------------------------------------------------- what is said

    def send(self, sequence: int, payload: bytes) -> None:
        """Sends a rollout, again and again until it is answered for good."""
        with self._changed:
            self._uploader.add(sequence, payload)
        self._send_due()

    def fit_window(self, play_seconds: float, least: int, most: int) -> None:
        """See Uploader."""
        with self._changed:
            self._uploader.fit_window(play_seconds, least, most)

    def await_room(self) -> None:
        """Waits until one more rollout may be played, and then sent. Raises as `wait` does."""
        self.wait(lambda: self._uploader.has_room)

    def await_word(self, timeout: float) -> None:
        """Waits for anything that the learner says, so many seconds at most. Raises as `wait` does."""
        since = self._heard_at
        self.wait(lambda: self._heard_at > since, timeout)

    @property
    def newest_version(self) -> int:
        """The newest policy version that any answer told of."""
        return self._uploader.newest_version

    @property
    def must_replace(self) -> bool:
        """Whether the last answer was a rejection: another rollout is to take the place of that one."""
        return self._uploader.must_replace

    def replace(self) -> None:
        """Another is about to."""
        with self._changed:
            self._uploader.must_replace = False

    @property
    def refusals(self) -> tuple[int, str]:
        """How many of the last answers in a row were rejections, and what the last of them gave for a reason."""
        with self._changed:
            return self._uploader.refused_in_a_row, self._uploader.reason

    # --------------------------------------------------------------------------------------------- waiting

    def wait(self, ready: Callable[[], bool], timeout: float | None = None) -> bool:
        """Waits until `ready`, sending what falls due meanwhile; False if `timeout` seconds passed first.

        Raises as `check` does.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            self._send_due()
            self._break_silence()
            with self._changed:
                self.check()
                if ready():
                    return True
                now = time.monotonic()
                if deadline is not None and now >= deadline:
                    return False
                due = self._uploader.next_due()
                until = min(t for t in (deadline, due, now + _HEARTBEAT_SECONDS) if t is not None)
                self._changed.wait(max(until - now, 0.0))

    def check(self) -> None:
        """Raises if there is a reason to stop playing: RunOverError, ActorError in quarantine, LearnerLostError."""
        if self._stop.is_set():
            raise RunOverError("stopped")
        if self._uploader.over == "quarantined":
            raise ActorError(
                f"the learner takes nothing more of this actor: {self._uploader.reason}; mend that and start it again"
            )
        if self._uploader.over == "finished":
            raise RunOverError("the run is over")
        if self._learner_left or self._uploader.over == "fenced":
            raise LearnerLostError

    def _break_silence(self) -> None:
        """Raises if nothing was heard for long, and nothing is to be heard: then a session is dead that seems alive."""
        if time.monotonic() > self._heard_at + _SILENCE_SECONDS:
            if not self._link.is_there(self._run, self._join):
                raise LearnerLostError
            with self._changed:
                self._heard_at = time.monotonic()

    def _send_due(self) -> None:
        uploader = self._uploader
        with self._changed:
            due = uploader.due(time.monotonic())
        for sequence, payload in due:
            try:
                self._transport.query_async(
                    keys.rollouts(self._run, self._join.actor),
                    payload,
                    timeout=_ACKNOWLEDGE_SECONDS,
                    on_answer=lambda answer, sequence=sequence: self._on_answer(uploader, sequence, answer),
                )
            except TransportError:
                self._on_answer(uploader, sequence, None)

    # ------------------------------------------------------------------------------------- from any thread

    def wake(self) -> None:
        """Has a wait look again at what it waits for."""
        with self._changed:
            self._changed.notify_all()

    def hear(self) -> None:
        """The learner said something."""
        with self._changed:
            self._heard_at = time.monotonic()
            self._changed.notify_all()

    def on_learner(self, _key: str, present: bool) -> None:
        """A learner of the run came or went."""
        with self._changed:
            # Whoever is there next may be another: to be asked.
            self._learner_left = self._learner_left or not present
            self._changed.notify_all()

    def _on_answer(self, uploader: Uploader, sequence: int, data: bytes | None) -> None:
        answer = None
        if data is not None:
            try:
                answer = decode(data, _ANSWER_LIMITS)
            except ProtocolError:
                answer = None
        with self._changed:
            if data is not None:
                self._heard_at = time.monotonic()
            uploader.answered(sequence, answer if isinstance(answer, Acknowledgement) else None, time.monotonic())
            self._changed.notify_all()
