"""Queries for the status of learners: the state of each run, its actors page by page, its newest events."""

import time

from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import STATUS_LIMITS
from daedalus.protocol.messages import ActorsReport, ActorsRequest, EventsReport, EventsRequest, StatusReport
from daedalus.protocol.status import ActorStatus, EventsPage, RunStatus
from daedalus.transport.interface import Transport

_ANSWER_SECONDS = 5.0
_PAGES_SECONDS = 3.0  # for all pages of a run


def ask(transport: Transport, run: str = keys.ANY_RUN, *, max_actors: int | None = None) -> list[RunStatus]:
    """Return the status of each learner that answers within 5 s. Raises TransportError or ProtocolError.

    Args:
      transport: the network.
      run: name of the run, or `*` for all runs.
      max_actors: the number of actors of each run after which no further page is fetched; None: all actors.
    """
    answers = transport.query(keys.status(run), timeout=_ANSWER_SECONDS)
    reports = [decode(answer, STATUS_LIMITS) for answer in answers]
    statuses = [report.status for report in reports if isinstance(report, StatusReport)]
    return [_with_actors(transport, status, max_actors) for status in statuses]


def no_answer(transport: Transport, run: str) -> str:
    """Return the error message where no learner of a run answers, with the runs that do. Raises as `ask` does."""
    there = "" if run == keys.ANY_RUN else ", ".join(sorted(repr(each.run) for each in ask(transport, max_actors=0)))
    if there:
        return f"no learner of run {run!r} answers; the runs here are {there}"
    return "no learner answers at this address: is a learner running?"


def ask_events(transport: Transport, status: RunStatus) -> EventsPage | None:
    """Return the newest events of a run, or None if its learner does not answer. Raises as `ask` does."""
    for answer in transport.query(keys.status(status.run), encode(EventsRequest()), timeout=_ANSWER_SECONDS):
        report = decode(answer, STATUS_LIMITS)
        if isinstance(report, EventsReport) and report.page.learner_epoch == status.learner_epoch:
            return report.page
    return None


def _with_actors(transport: Transport, status: RunStatus, max_actors: int | None) -> RunStatus:
    """Return the status with the actors of the further pages, as far as the learner answers in time."""
    actors, deadline = list(status.actors), time.monotonic() + _PAGES_SECONDS
    wanted = status.fleet_size if max_actors is None else min(status.fleet_size, max_actors)
    while actors and len(actors) < wanted and time.monotonic() < deadline:
        more = _page(transport, status, actors[-1].actor)
        if not more:
            break
        actors += more
    return status.model_copy(update={"actors": tuple(actors)})


def _page(transport: Transport, status: RunStatus, after: str) -> tuple[ActorStatus, ...]:
    """Return the actors whose names come next; none without an answer, or if another learner has replaced this one."""
    request = encode(ActorsRequest(after=after))
    for answer in transport.query(keys.status(status.run), request, timeout=_ANSWER_SECONDS):
        report = decode(answer, STATUS_LIMITS)
        if isinstance(report, ActorsReport) and report.page.learner_epoch == status.learner_epoch:
            return report.page.actors
    return ()
