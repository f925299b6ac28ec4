"""Answers to operators: the status, its further actors, the newest events, and the metrics of the whole run.

State that the transport's threads read.
"""

import threading
import time
from collections.abc import Callable

from daedalus.learner.serving.events import EventLog
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.fleet_status import page
from daedalus.learner.serving.metrics_history import MetricsHistory
from daedalus.learner.serving.requests import read_request
from daedalus.protocol.limits import STATUS_REQUEST_LIMITS
from daedalus.protocol.messages import (
    ActorsPage,
    ActorsReport,
    ActorsRequest,
    EventsPage,
    EventsReport,
    EventsRequest,
    Message,
    MetricsRequest,
    Refusal,
    RunStatus,
    StatusReport,
)
from daedalus.transport.interface import Request


class StatusResponses:
    """Answers to the queries for the status of one learner."""

    def __init__(
        self,
        run: str,
        learner_epoch: int,
        status: Callable[[], RunStatus],
        fleet: Fleet,
        lock: threading.Condition,
        events: EventLog,
        history: MetricsHistory,
    ) -> None:
        """`status` returns the status with the first page of actors; it is called with `lock` held."""
        self._run, self._epoch, self._status = run, learner_epoch, status
        self._fleet, self._lock, self._events, self._history = fleet, lock, events, history

    def answer(self, request: Request) -> Message:
        """Return the status, or what the payload requests."""
        if not request.size:
            with self._lock:
                return StatusReport(status=self._status())
        message = read_request(request.payload, STATUS_REQUEST_LIMITS, ActorsRequest, EventsRequest, MetricsRequest)
        match message:
            case ActorsRequest():
                with self._lock:
                    actors = page(self._fleet, message.after, time.monotonic())
                return ActorsReport(page=ActorsPage(learner_epoch=self._epoch, actors=actors))
            case EventsRequest():
                events = self._events.report()
                return EventsReport(page=EventsPage(run=self._run, learner_epoch=self._epoch, events=events))
            case MetricsRequest():
                return self._history.page(self._run, self._epoch, message.first)
            case Refusal():
                return message
