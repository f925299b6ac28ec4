"""Queries for the status of learners: the state of each run, its actors page by page, its newest events."""

import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, UnfitMessageError, VersionMismatchError, decode, encode
from daedalus.protocol.limits import STATUS_LIMITS, Limits
from daedalus.protocol.messages import (
    ActorsReport,
    ActorsRequest,
    EventsPage,
    EventsReport,
    EventsRequest,
    RunStatus,
    StatusReport,
)
from daedalus.protocol.texts import MAX_NAME, bounded_text
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_Kind = TypeVar("_Kind")

_ANSWER_SECONDS = 5.0
_PAGES_SECONDS = 3.0  # for all pages of a run
_MAX_UNREAD = 32  # runs that are named


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """The learners that answered, as far as this release can read them."""

    statuses: list[RunStatus]
    unread: dict[str, str]  # by run: why its learner's answer cannot be read, and what to do

    @property
    def left_out(self) -> list[str]:
        """A line for a person about each run that cannot be read."""
        return [f"run {run!r} is left out: {reason}" for run, reason in sorted(self.unread.items())]

    def log(self) -> None:
        """Log what is left out, each line once."""
        for line in self.left_out:
            _warn(line)


def ask(transport: Transport, run: str = keys.ANY_RUN, *, max_actors: int | None = None) -> list[RunStatus]:
    """Return the status of each learner that answers within 5 s, as `survey` does.

    A learner that cannot be read is logged once, with its run and what to do, and left out. Raises TransportError, and
    ProtocolError if none can be read.
    """
    found = survey(transport, run, max_actors=max_actors)
    if found.unread and not found.statuses:
        raise ProtocolError("; ".join(found.left_out))
    found.log()
    return found.statuses


def survey(transport: Transport, run: str = keys.ANY_RUN, *, max_actors: int | None) -> Survey:
    """Return the status of each learner that answers within 5 s, and what cannot be read. Raises TransportError.

    The statuses are sorted by run. If several learners of one run answer, the newest is first, and each other one has
    the problem that it is not the newest.

    Args:
      transport: the network.
      run: name of the run, or `*` for all runs.
      max_actors: the number of actors of each run after which no further page is fetched; None: all actors.
    """
    statuses, unread = [], dict[str, str]()
    for key, answer in transport.query_by_key(keys.status(run), timeout=_ANSWER_SECONDS):
        try:
            message = decode(answer, STATUS_LIMITS)
            if not isinstance(message, StatusReport):
                raise ProtocolError(f"{type(message).__name__} in place of a status")
            statuses.append(message.status)
        except ProtocolError as error:
            if len(unread) < _MAX_UNREAD:
                unread[bounded_text(key.split("/")[1], MAX_NAME)] = _remedy(bounded_text(key), error)
    return Survey(
        statuses=[_with_actors(transport, status, max_actors) for status in _newest_first(statuses)], unread=unread
    )


def _remedy(key: str, error: ProtocolError) -> str:
    """Return why an answer with this key cannot be read, whose fault that is, and what to do."""
    match error:
        case VersionMismatchError():
            return f"its learner is of another release; {error}"
        case UnfitMessageError():
            release = error.release or "the release of daedalus-rl that it has"
            return f"its learner is of another release ({error}): ask with {release}"
        case _:
            return f"what answers for its learner is not one ({error}): find out which process serves {key}"


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
    """Return the error message where no learner of a run answers, with the runs that do. Raises TransportError."""
    found = Survey(statuses=[], unread={}) if run == keys.ANY_RUN else survey(transport, max_actors=0)
    runs = {status.run for status in found.statuses} | found.unread.keys()
    if runs:
        there = ", ".join(map(repr, sorted(runs)))
        return f"no learner of run {run!r} answers; the runs here are {there}"
    return "no learner answers at this address: is a learner running?"


def ask_events(transport: Transport, status: RunStatus) -> EventsPage | None:
    """Return the newest events of a run, or None if its learner gives none that can be read. Raises TransportError."""
    answers = transport.query(keys.status(status.run), encode(EventsRequest()), timeout=_ANSWER_SECONDS)
    for report in _of_run(status, answers, EventsReport):
        if report.page.learner_epoch == status.learner_epoch:
            return report.page
    return None


def _of_run(status: RunStatus, answers: list[bytes], kind: type[_Kind]) -> list[_Kind]:
    """Return the further messages about a run; what cannot be read is logged once, and hides no other run."""
    try:
        return decoded(answers, kind)
    except ProtocolError as error:
        _warn(f"run {status.run!r} is shown in part: {_remedy(keys.status(status.run), error)}")
        return []


def waiting_actors(transport: Transport) -> dict[str, list[int]]:
    """Return the names and incarnations of the actors that wait for a run. Raises TransportError."""
    found: dict[str, list[int]] = {}
    for key in transport.present(keys.presence(keys.NO_RUN, "*", "*")):
        parsed = keys.parse_presence(key)
        if parsed is not None and keys.is_name(parsed[0]):
            found.setdefault(parsed[0], []).append(parsed[1])
    return dict(sorted(found.items()))


def _with_actors(transport: Transport, status: RunStatus, max_actors: int | None) -> RunStatus:
    """Return the status with the actors of the further pages, as far as the learner answers in time. Each once."""
    actors, deadline = {actor.actor: actor for actor in status.actors}, time.monotonic() + _PAGES_SECONDS
    wanted = status.fleet_size if max_actors is None else min(status.fleet_size, max_actors)
    while actors and len(actors) < wanted and (left := deadline - time.monotonic()) > 0.0:
        last = max(actors)
        request = encode(ActorsRequest(after=last))
        answers = transport.query(keys.status(status.run), request, timeout=left)
        # None without an answer, or if another learner has replaced this one.
        pages = [each.page for each in _of_run(status, answers, ActorsReport)]
        more = [each.actors for each in pages if each.learner_epoch == status.learner_epoch][:1]
        actors |= {actor.actor: actor for page in more for actor in page if actor.actor > last}
        if max(actors) == last:
            break
    return status.model_copy(update={"actors": tuple(actors.values())})
