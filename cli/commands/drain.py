"""`daedalus drain`: ask actors to leave after their current rollout, and wait until they have left."""

import argparse
import time

from daedalus.cli.arguments import add_connect, add_tls, command_parser, seconds
from daedalus.launch.logs import print_error, say
from daedalus.launch.process_lifecycle import status_at_start
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS
from daedalus.protocol.messages import Acknowledgement, Refusal, RunStatus
from daedalus.protocol.texts import MAX_ANSWER_TEXT, bounded_text
from daedalus.transport.connecting import connect_once
from daedalus.transport.credentials import SECURITY_ERRORS, credentials_to_connect
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.status_query import ask, decoded, newest_of_each_run, no_answer

LEFT, FAILED = 0, 1

_DESCRIPTION = """\
Asks actors to leave. Each actor ends with exit status 0 as soon as the learner has judged its current rollout, also if
it was started with --stay. The command returns when all of them have left."""

_EXAMPLES = """\
examples:
  daedalus drain arm-3 --connect tcp/127.0.0.1:7447
  daedalus drain box-1 box-2 --connect tls/gpu-box:7447 --tls certs/operator

exit status: 0 the actors have left, 1 failed, 2 bad usage"""

_ANSWER_SECONDS = 5.0
_POLL_SECONDS = 0.5


class DrainError(Exception):
    """The actors cannot be drained, or did not leave in time; the message says why."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus drain`."""
    options = command_parser("drain", _DESCRIPTION, _EXAMPLES)
    options.add_argument("actors", nargs="+", metavar="ACTOR", help="name of an actor, as `daedalus status` shows it")
    add_connect(options, "address of the learner or of its router. May be given several times")
    options.add_argument("--run", default=keys.ANY_RUN, metavar="NAME", help="run that the actors take part in")
    options.add_argument(
        "--timeout", type=seconds, metavar="SECONDS", help="time to wait for the actors to leave (default: no limit)"
    )
    add_tls(options)
    return options


def drain(arguments: list[str]) -> int:
    """Run `daedalus drain` and return its exit status."""
    parsed = parser().parse_args(arguments)
    try:
        names = [keys.check_name(name, "actor name") for name in parsed.actors]
        credentials = credentials_to_connect(parsed.connect, parsed.tls, "operator", "learner", "router")
    except (ValueError, *SECURITY_ERRORS) as error:
        print_error("drain", error)
        return status_at_start(error)
    try:
        transport = connect_once(parsed.connect, credentials, parsed.timeout)
        try:
            drain_actors(transport, parsed.run, names, parsed.timeout)
        except KeyboardInterrupt:
            print_error("drain", "interrupted; the requests remain in force")
            return FAILED
        finally:
            transport.close()
    except (TransportError, ProtocolError, DrainError) as error:
        print_error("drain", error)
        return FAILED
    return LEFT


def drain_actors(transport: Transport, run: str, names: list[str], timeout: float | None) -> None:
    """Ask actors to leave, and wait until they have left.

    Raises DrainError, TransportError or ProtocolError.

    Args:
      transport: the network.
      run: name of the run, or `*` for all runs.
      names: names of the actors.
      timeout: seconds to wait until they have left; None: no limit.
    """
    epochs: set[int] = set()  # of the learners that accepted
    for name in names:
        for status in _statuses_with(transport, run, name):
            _request(transport, status.run, name)
            epochs.add(status.learner_epoch)
    _await_departures(transport, run, epochs, set(names), timeout)


def _statuses_with(transport: Transport, run: str, name: str) -> list[RunStatus]:
    """Return the statuses of the runs that an actor takes part in: of each, that of its newest learner.

    Raises DrainError if there is none.
    """
    statuses = newest_of_each_run(ask(transport, run))
    if not statuses:
        raise DrainError(no_answer(transport, run))
    found = [each for each in statuses if any(actor.actor == name and actor.alive for actor in each.actors)]
    if not found:
        raise DrainError(f"no actor {name!r} takes part: `daedalus status` lists them")
    return found


def _request(transport: Transport, run: str, name: str) -> None:
    """Ask the learners of a run to drain an actor. Raises DrainError if none of them accepts the request."""
    answers = transport.query(keys.drain(run, name), timeout=_ANSWER_SECONDS)
    if not answers:
        raise DrainError(f"the learner of run {run!r} does not answer: run this command again")
    if not decoded(answers, Acknowledgement, ACKNOWLEDGEMENT_LIMITS):
        for refusal in decoded(answers, Refusal, ACKNOWLEDGEMENT_LIMITS):
            raise DrainError(bounded_text(refusal.reason, MAX_ANSWER_TEXT))
    say(f"actor {name} leaves run {run!r} after its current rollout")


def _await_departures(transport: Transport, run: str, epochs: set[int], names: set[str], timeout: float | None) -> None:
    """Wait until no actor of these names is alive. Raises DrainError after `timeout` seconds, or without a learner."""
    deadline = None if timeout is None else time.monotonic() + timeout
    while True:
        statuses = [status for status in ask(transport, run) if status.learner_epoch in epochs]
        if {status.learner_epoch for status in statuses} != epochs:
            there = ", ".join(sorted(names))
            raise DrainError(f"the learner ended or was restarted; run this command again if needed for: {there}")
        alive = {actor.actor for status in statuses for actor in status.actors if actor.alive}
        for name in sorted(names - alive):
            say(f"actor {name} has left")
        names &= alive
        if not names:
            return
        if deadline is not None and time.monotonic() > deadline:
            there = ", ".join(sorted(names))
            raise DrainError(f"still there after {timeout:g} s: {there}; the request remains in force")
        time.sleep(_POLL_SECONDS)
