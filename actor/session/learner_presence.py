"""What an actor knows about its learner being there. State without threads or I/O."""

import time

from daedalus.actor.session.state_lock import StateLock


class LearnerPresence:
    """When the learner was last heard, and whether it left. The lock guards both."""

    def __init__(self, lock: StateLock) -> None:
        self._lock = lock
        self._left = False
        self._heard_at = 0.0

    @property
    def left(self) -> bool:
        """Whether a learner of the run left since `joined`: the one there now may be another."""
        return self._left

    @property
    def heard_at(self) -> float:
        """The monotonic time of the last message of the learner."""
        return self._heard_at

    def joined(self) -> None:
        """Forget what was known about an earlier learner: one has just answered a request to join."""
        with self._lock:
            self._left, self._heard_at = False, time.monotonic()

    def heard(self) -> None:
        """Note a message of the learner. From any thread."""
        with self._lock:
            self._heard_at = time.monotonic()
            self._lock.announce_change()

    def on_presence(self, _key: str, present: bool) -> None:
        """Note that a learner of the run came or left. Called on the transport's threads."""
        with self._lock:
            self._left = self._left or not present
            self._lock.announce_change()
