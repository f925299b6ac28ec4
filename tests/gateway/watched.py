"""A source that returns what the test says, and observations of it, for tests of the page."""

import threading
from dataclasses import replace

import numpy as np

from daedalus.gateway.watching.page_data import Observation
from daedalus.protocol.messages import Event, EventsPage, MetricsPage, MetricsReport, Order, RunStatus
from daedalus.transport.interface import TransportError

HOSTILE = '<img src=x onerror="document.title=1">'  # a text of a peer


class FakeSource:
    """A RunSource."""

    def __init__(self) -> None:
        self.answer: RunStatus | None = None
        self.fails = False
        self.newest_events: tuple[Event, ...] = ()
        self.rows: list[dict[str, float]] = []
        self.oldest = 0  # row that it still has
        self.page_rows = 3  # in one answer
        self.asked_actors: list[int] = []
        self.orders: list[tuple[Order, str]] = []
        self.asked = threading.Semaphore(0)

    def status(self, max_actors: int) -> RunStatus | None:
        self.asked.release()
        if self.fails:
            raise TransportError("the router is gone")
        self.asked_actors.append(max_actors)
        return self.answer

    def events(self, status: RunStatus) -> EventsPage | None:
        return EventsPage(run=status.run, learner_epoch=status.learner_epoch, events=self.newest_events)

    def metrics(self, status: RunStatus, first: int) -> MetricsReport | None:
        numbers = list(range(max(first, self.oldest), len(self.rows)))[: self.page_rows]
        columns = tuple(sorted({name for number in numbers for name in self.rows[number]}))
        values = [[self.rows[number].get(name, np.nan) for name in columns] for number in numbers]
        return MetricsReport(
            page=MetricsPage(run=status.run, learner_epoch=status.learner_epoch, columns=columns),
            numbers=np.array(numbers, np.int64),
            values=np.array(values, np.float64).reshape(len(numbers), len(columns)),
        )

    def order(self, status: RunStatus, order: Order, token: str) -> tuple[bool, str]:
        self.orders.append((order, token))
        return True, "checkpoint saved at 7 env_steps" if order == "checkpoint" else ""


def observed(status: RunStatus, rows: list[dict[str, float]] | None = None, **fields: object) -> Observation:
    """Return a running run."""
    seen = Observation(state="running", status=status, actors=status.actors, rows=tuple(enumerate(rows or [])))
    return replace(seen, **fields)  # type: ignore[arg-type] - fields of an Observation
