"""A limit on the messages of one client. State without threads or I/O."""

MESSAGES_PER_SECOND, _BURST = 1000.0, 2000.0


class RateLimit:
    """A bucket of permissions that fills at a constant rate."""

    def __init__(self, rate: float = MESSAGES_PER_SECOND, burst: float = _BURST) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._at = burst, 0.0

    def take(self, now: float) -> float:
        """Take one permission at a monotonic time; return the seconds to wait before it may be used."""
        self._left = min(self._left + (now - self._at) * self._rate, self._burst) - 1.0
        self._at = now
        return max(-self._left, 0.0) / self._rate
