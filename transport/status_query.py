"""Queries for the status of learners: the state of each run, its actors page by page, its newest events."""

import logging
import time
from collections.abc import Iterable
from functools import lru_cache
from typing import TypeVar

from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import STATUS_LIMITS, Limits
from daedalus.protocol.messages import (
    ActorsReport,
    ActorsRequest,
    ActorStatus,
    EventsPage,
    EventsReport,
    EventsRequest,
    RunStatus,
    StatusReport,
)
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_Kind = TypeVar("_Kind")

_ANSWER_SECONDS = 5.0
_PAGES_SECONDS = 3.0  # for all pages of a run


def ask(transport: Transport, run: str = keys.ANY_RUN, *, max_actors: int | None = None) -> list[RunStatus]:
    """Return the status of each learner that answers within 5 s. Raises TransportError or ProtocolError.

    They are sorted by run. If several learners of one run answer, the newest is first, and each other one has the
    problem that it is not the newest.

    Args:
      transport: the network.
      run: name of the run, or `*` for all runs.
      max_actors: the number of actors of each run after which no further page is fetched; None: all actors.
    """
    answers = transport.query(keys.status(run), timeout=_ANSWER_SECONDS)
    statuses = [report.status for report in decoded(answers, StatusReport)]
    return [_with_actors(transport, status, max_actors) for status in _newest_first(statuses)]


def decoded(
    answers: Iterable[bytes], kind: type[_Kind] | tuple[type[_Kind], ...], limits: Limits = STATUS_LIMITS
) -> list[_Kind]:
    """Return the messages of a kind, or of several, among the answers of several learners.

    One that cannot be read, such as that of another release, is logged and ignored. Raises ProtocolError if no answer
    can be read.
    """
    messages, unread = [], None
    for answer in answers:
        try:
            messages.append(decode(answer, limits))
        except ProtocolError as error:
            unread = error
    if unread is not None:
        if not messages:
            raise unread
        _warn(f"ignored the answer of another learner: {unread}")
    return [message for message in messages if isinstance(message, kind)]


@lru_cache(maxsize=16)  # once, and not at each look of a service
def _warn(text: str) -> None:
    _logger.warning("%s", text)


def newest_of_each_run(statuses: Iterable[RunStatus]) -> list[RunStatus]:
    """Return the status of the newest learner of each run, sorted by run."""
    newest: dict[str, RunStatus] = {}
    for status in sorted(statuses, key=lambda status: (status.run, status.learner_epoch)):
        newest[status.run] = status
    return list(newest.values())


def _newest_first(statuses: list[RunStatus]) -> list[RunStatus]:
    """Return the statuses as `ask` sorts them, with the problem of those that are not the newest."""
    newest = {status.run: status.learner_epoch for status in newest_of_each_run(statuses)}
    shown = []
    for status in sorted(statuses, key=lambda status: (status.run, -status.learner_epoch)):
        if status.learner_epoch != newest[status.run]:
            problem = (
                f"the learner with epoch {status.learner_epoch:x} is not the newest of this run: actors follow epoch "
                f"{newest[status.run]:x}, and this one is to step down"
            )
            status = status.model_copy(update={"problems": (problem, *status.problems)})
        shown.append(status)
    return shown


def no_answer(transport: Transport, run: str) -> str:
    """Return the error message where no learner of a run answers, with the runs that do. Raises as `ask` does."""
    statuses = [] if run == keys.ANY_RUN else newest_of_each_run(ask(transport, max_actors=0))
    if statuses:
        there = ", ".join(repr(status.run) for status in statuses)
        return f"no learner of run {run!r} answers; the runs here are {there}"
    return "no learner answers at this address: is a learner running?"


def ask_events(transport: Transport, status: RunStatus) -> EventsPage | None:
    """Return the newest events of a run, or None if its learner does not answer. Raises as `ask` does."""
    answers = transport.query(keys.status(status.run), encode(EventsRequest()), timeout=_ANSWER_SECONDS)
    for report in decoded(answers, EventsReport):
        if report.page.learner_epoch == status.learner_epoch:
            return report.page
    return None


def waiting_actors(transport: Transport) -> dict[str, list[int]]:
    """Return the names and incarnations of the actors that wait for a run. Raises TransportError."""
    found: dict[str, list[int]] = {}
    for key in transport.present(keys.presence(keys.NO_RUN, "*", "*")):
        parsed = keys.parse_presence(key)
        if parsed is not None and keys.is_name(parsed[0]):
            found.setdefault(parsed[0], []).append(parsed[1])
    return dict(sorted(found.items()))


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
    for report in decoded(transport.query(keys.status(status.run), request, timeout=_ANSWER_SECONDS), ActorsReport):
        if report.page.learner_epoch == status.learner_epoch:
            return report.page.actors
    return ()
