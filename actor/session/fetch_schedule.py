"""When an actor fetches a snapshot: so that it comes as the next rollout begins. State without threads or I/O.

An actor uses one snapshot for each rollout. If it fetched that snapshot when the rollout begins, it would wait for the
answer; if it fetched the snapshot much earlier, the policy would be older than necessary.
"""

_LEAST_PATIENCE, _MOST_PATIENCE = 0.1, 0.25  # of a wait for an answer, relative to the duration of a rollout
_FIRST_SECONDS = 1.0  # the expected duration of the first rollout


class FetchSchedule:
    """The schedule of one session. All times are monotonic, in seconds."""

    def __init__(self) -> None:
        self._began, self._rollout_seconds = 0.0, 0.0  # of the last rollout
        self._due_at = 0.0
        self._fetch_seconds = 0.0  # of the last fetch
        self._lead = 0.0  # how long before the end of a rollout the fetch is due
        self._asked_at, self._interval = 0.0, 0.0  # of calls of `is_due`

    def begin_rollout(self, now: float, fetch_seconds: float) -> None:
        """Note that a rollout begins, and how long the last fetch took."""
        self._began = self._asked_at = now
        self._fetch_seconds = fetch_seconds
        self._lead = fetch_seconds + self._interval
        expected = self._rollout_seconds or _FIRST_SECONDS
        self._due_at = now + max(expected - self._lead, 0.0)

    def is_due(self, now: float) -> bool:
        """Return whether to fetch now, in the course of a rollout. Call this often, such as before each row.

        True once as the rollout nears the duration of the one before, and again if it takes much longer.
        """
        self._interval, self._asked_at = now - self._asked_at, now
        if now < self._due_at:
            return False
        self._due_at = now + max(self._rollout_seconds, now - self._began)
        return True

    def end_rollout(self, now: float) -> None:
        """Note that the rollout is complete."""
        self._rollout_seconds = now - self._began

    @property
    def rollout_seconds(self) -> float:
        """Duration of the last rollout."""
        return self._rollout_seconds

    def is_stale(self, now: float, requested_at: float) -> bool:
        """Return whether a snapshot that was requested at a time is too old for a rollout that begins now."""
        return now > requested_at + self._lead + self.patience

    @property
    def patience(self) -> float:
        """The longest time for a rollout that is about to begin to wait for its snapshot."""
        least, most = _LEAST_PATIENCE * self._rollout_seconds, _MOST_PATIENCE * self._rollout_seconds
        return min(max(2.0 * self._fetch_seconds, least), most)
