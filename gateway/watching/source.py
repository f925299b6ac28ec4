"""Where the page's data come from. The command line has the implementation."""

from dataclasses import dataclass
from typing import Protocol

from daedalus.protocol.messages import EventsPage, MetricsReport, Order, RunStatus


class RunSource(Protocol):
    """The learner of one run, as an operator may query it. Calls wait for its answer, at most a few seconds.

    All methods raise TransportError or ProtocolError.
    """

    def status(self, max_actors: int) -> RunStatus | None:
        """Return the status with its first actors, at least `max_actors` if there are so many; None without answer."""
        ...

    def events(self, status: RunStatus) -> EventsPage | None:
        """Return the newest events of a run, or None without an answer."""
        ...

    def metrics(self, status: RunStatus, first: int) -> MetricsReport | None:
        """Return the rows from number `first` on, as many as one answer has; None without an answer."""
        ...

    def order(self, status: RunStatus, order: Order) -> tuple[bool, str]:
        """Give an order; return whether it is accepted, and what came of it or why it is not."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherRun:
    """An earlier run that the page compares with."""

    name: str
    rows: list[dict[str, float]]  # by column
