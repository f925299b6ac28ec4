"""`daedalus stop`, `checkpoint` and `drain`: an operator's orders to the learner of a run, and to its actors."""

import argparse
import time
from collections.abc import Callable

from daedalus.cli.arguments import add_connect, add_tls, command_parser, seconds
from daedalus.launch.logs import print_error, say
from daedalus.launch.process_lifecycle import status_at_start
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError
from daedalus.protocol.messages import RunStatus
from daedalus.transport.connecting import connect_once
from daedalus.transport.credentials import SECURITY_ERRORS, credentials_to_connect, run_for
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.operator_orders import Operator, OrderError
from daedalus.transport.status_query import ask, newest_of_each_run, no_answer, waiting_actors

DONE, FAILED = 0, 1

_AUTHOR = """\
The run notes who gave the order: the operator named in the certificate of --tls, or this host without one. It is in the
log of the learner, in `daedalus status` and its --events, in summary.json and in the report."""

_STOP = f"""\
Stops a run: its learner saves a checkpoint and ends with exit status 0. Its actors wait for the run to be continued
with `daedalus learner --resume`, or `daedalus resume`. The command returns when the learner has ended.

{_AUTHOR}"""

_STOP_EXAMPLES = """\
examples:
  daedalus stop cartpole --connect tcp/127.0.0.1:7447
  daedalus stop cartpole --connect tls/gpu-box:7447 --tls certs/operator

exit status: 0 the checkpoint is saved and the learner has ended, 1 failed, 2 bad usage"""

_CHECKPOINT = f"""\
Lets the learner of a run save a checkpoint now, beside training.

{_AUTHOR}"""

_CHECKPOINT_EXAMPLES = """\
examples:
  daedalus checkpoint cartpole --connect tcp/127.0.0.1:7447
  daedalus checkpoint cartpole --connect tls/gpu-box:7447 --tls certs/operator

exit status: 0 saved, or being written to a slow disk (the output says which), 1 failed, 2 bad usage"""

_DRAIN = f"""\
Asks actors to leave. Each actor ends with exit status 0 as soon as the learner has judged its current rollout, or at
once if it waits for a run; also if it was started with --stay. The command returns when all of them have left. To drain
an actor from its own host, send it SIGUSR1 (see daedalus actor --help).

{_AUTHOR}"""

_DRAIN_EXAMPLES = """\
examples:
  daedalus drain arm-3 --connect tcp/127.0.0.1:7447
  daedalus drain box-1 box-2 --connect tls/gpu-box:7447 --tls certs/operator

exit status: 0 the actors have left, 1 failed, 2 bad usage"""

_POLL_SECONDS = 0.5


def stop_parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus stop`."""
    options = _run_parser("stop", _STOP, _STOP_EXAMPLES)
    options.add_argument(
        "--timeout", type=seconds, metavar="SECONDS", help="time to wait for the learner to end (default: no limit)"
    )
    return options


def checkpoint_parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus checkpoint`."""
    return _run_parser("checkpoint", _CHECKPOINT, _CHECKPOINT_EXAMPLES)


def _run_parser(name: str, description: str, examples: str) -> argparse.ArgumentParser:
    options = command_parser(name, description, examples)
    options.add_argument("run", metavar="RUN", help="name of the run, as `daedalus status` shows it")
    add_connect(options)
    add_tls(options)
    return options


def drain_parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus drain`."""
    options = command_parser("drain", _DRAIN, _DRAIN_EXAMPLES)
    options.add_argument("actors", nargs="+", metavar="ACTOR", help="name of an actor, as `daedalus status` shows it")
    add_connect(options)
    options.add_argument("--run", default=keys.ANY_RUN, metavar="NAME", help="run that the actors take part in")
    options.add_argument(
        "--timeout", type=seconds, metavar="SECONDS", help="time to wait for the actors to leave (default: no limit)"
    )
    add_tls(options)
    return options


def stop(arguments: list[str]) -> int:
    """Run `daedalus stop` and return its exit status."""
    parsed = stop_parser().parse_args(arguments)
    return _give(
        "stop",
        parsed,
        [parsed.run],
        lambda transport, operator: stop_run(transport, operator, parsed.run, parsed.timeout),
    )


def checkpoint(arguments: list[str]) -> int:
    """Run `daedalus checkpoint` and return its exit status."""
    parsed = checkpoint_parser().parse_args(arguments)
    return _give(
        "checkpoint", parsed, [parsed.run], lambda transport, operator: save_checkpoint(transport, operator, parsed.run)
    )


def drain(arguments: list[str]) -> int:
    """Run `daedalus drain` and return its exit status."""
    parsed = drain_parser().parse_args(arguments)
    return _give(
        "drain",
        parsed,
        parsed.actors,
        lambda transport, operator: drain_actors(transport, operator, parsed.run, parsed.actors, parsed.timeout),
    )


def _give(
    command: str, parsed: argparse.Namespace, names: list[str], order: Callable[[Transport, Operator], None]
) -> int:
    """Give an order over the network, and return the exit status of the command. `names` are checked before."""
    try:
        for name in names:
            keys.check_name(name, "name")
        credentials = credentials_to_connect(parsed.connect, parsed.tls, "operator", "learner", "router")
        parsed.run = run_for(credentials, parsed.run)
    except (ValueError, *SECURITY_ERRORS) as error:
        print_error(command, error)
        return status_at_start(error)
    try:
        transport = connect_once(parsed.connect, credentials, getattr(parsed, "timeout", None))
        try:
            order(transport, Operator.here(credentials))
        except KeyboardInterrupt:
            print_error(command, "interrupted; the order remains in force")
            return FAILED
        finally:
            transport.close()
    except (TransportError, ProtocolError, OrderError) as error:
        print_error(command, error)
        return FAILED
    return DONE


def stop_run(transport: Transport, operator: Operator, run: str, timeout: float | None) -> None:
    """Stop a run, and wait until its learner has ended, for `timeout` seconds (None: no limit).

    Raises OrderError, TransportError or ProtocolError.
    """
    status = _status_of(transport, run)
    say(f"run {run!r}: {operator.give(transport, status, 'stop')}")
    deadline = None if timeout is None else time.monotonic() + timeout
    while any(each.learner_epoch == status.learner_epoch for each in ask(transport, run, max_actors=0)):
        if deadline is not None and time.monotonic() > deadline:
            raise OrderError(f"the learner is still there after {timeout:g} s; the order remains in force")
        time.sleep(_POLL_SECONDS)
    say(f"run {run!r}: the learner has ended")


def save_checkpoint(transport: Transport, operator: Operator, run: str) -> None:
    """Let the learner of a run save a checkpoint. Raises OrderError, TransportError or ProtocolError."""
    say(f"run {run!r}: {operator.give(transport, _status_of(transport, run), 'checkpoint')}")


def _status_of(transport: Transport, run: str) -> RunStatus:
    """Return the status of the newest learner of a run. Raises OrderError if none answers."""
    statuses = newest_of_each_run(ask(transport, run, max_actors=0))
    if not statuses:
        raise OrderError(no_answer(transport, run))
    return statuses[0]


def drain_actors(transport: Transport, operator: Operator, run: str, names: list[str], timeout: float | None) -> None:
    """Ask actors to leave, and wait until they have left.

    Raises OrderError, TransportError or ProtocolError.

    Args:
      transport: the network.
      operator: gives the orders.
      run: name of the run, or `*` for all runs, and for actors that wait for one.
      names: names of the actors.
      timeout: seconds to wait until they have left; None: no limit.
    """
    deadline = None if timeout is None else time.monotonic() + timeout
    seen = _Whereabouts(transport, run)
    for name in names:
        if not seen.is_there(name):
            raise OrderError(
                f"no actor {name!r} takes part or waits for a run: `daedalus status` lists them"
                if seen.runs
                else f"no actor {name!r} waits for a run, and {no_answer(transport, run)}"
            )
    there, ordered = set(names), set[tuple[str, int]]()  # actors, and learner epochs that know of the order
    while True:
        for name in sorted(there):
            for status in seen.runs_of(name):
                if (name, status.learner_epoch) not in ordered:
                    operator.give(transport, status, "drain", name)
                    say(f"actor {name} leaves run {status.run!r} after its current rollout")
                    ordered.add((name, status.learner_epoch))
            for incarnation in seen.waiting.get(name, ()):  # at each look: a publication may be lost
                operator.drain_waiting(transport, name, incarnation)
        if deadline is not None and time.monotonic() > deadline:
            raise OrderError(f"still there after {timeout:g} s: {', '.join(sorted(there))}; the order remains in force")
        time.sleep(_POLL_SECONDS)
        seen = _Whereabouts(transport, run)
        lost = sorted(name for name, epoch in ordered if name in there and epoch not in seen.epochs)
        if lost:
            again = f"run this command again if needed for: {', '.join(lost)}"
            raise OrderError(f"the learner ended or was restarted; {again}")
        for name in sorted(there):
            if not seen.is_there(name):
                there.remove(name)
                say(f"actor {name} has left")
        if not there:
            return


class _Whereabouts:
    """Where actors are, at one look: in runs, or waiting for one. Raises TransportError or ProtocolError."""

    def __init__(self, transport: Transport, run: str) -> None:
        """`run` is the name of a run, or `*` for all runs, and for actors that wait for one."""
        answers = ask(transport, run)
        self.runs, self.epochs = newest_of_each_run(answers), {status.learner_epoch for status in answers}
        self.waiting = waiting_actors(transport) if run == keys.ANY_RUN else {}

    def runs_of(self, name: str) -> list[RunStatus]:
        """Return the statuses of the runs that an actor takes part in."""
        return [run for run in self.runs if any(actor.actor == name and actor.alive for actor in run.actors)]

    def is_there(self, name: str) -> bool:
        """Return whether an actor takes part in a run, or waits for one."""
        return name in self.waiting or bool(self.runs_of(name))
