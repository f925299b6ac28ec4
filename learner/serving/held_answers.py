"""Answers to accepted rollouts that wait while the learner computes a batch. State without threads or I/O."""

from daedalus.transport.interface import Request

_MOST_SECONDS = 10.0  # an answer waits no longer: its sender would take the rollout for lost


class HeldAnswers:
    """The requests whose answers wait. The caller guards it with a lock, and answers without the lock."""

    def __init__(self) -> None:
        self._since: float | None = None  # when the learner began to compute; None: it does not
        self._waiting: list[Request] = []
        self._released: list[Request] = []

    @property
    def holds(self) -> bool:
        """Whether answers wait now."""
        return self._since is not None

    def begin(self, now: float) -> None:
        """Hold answers from now on: the learner computes. `now` is on the monotonic clock, in seconds."""
        self._since = now

    def release(self) -> None:
        """Hold answers no more. Those that wait may be taken, also if the next batch begins before they are."""
        self._since = None
        self._released += self._waiting
        self._waiting = []

    def add(self, request: Request) -> None:
        """Add a request. The caller has checked `holds`."""
        self._waiting.append(request)

    def take(self, now: float) -> list[Request]:
        """Return the requests to answer now: those that were released, and all if they have waited too long."""
        if self._since is not None and now > self._since + _MOST_SECONDS:
            self.release()
        released, self._released = self._released, []
        return released
