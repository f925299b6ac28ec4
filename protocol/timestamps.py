"""Times of the wall clock as text."""

from datetime import UTC, datetime


def utc(seconds: float) -> str:
    """Return a time, in seconds since 1970, in ISO 8601 with milliseconds, such as 2026-11-22T10:15:00.250Z."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
