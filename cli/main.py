"""`daedalus COMMAND`: finds the command and hands over. Imports nothing that the command does not need."""

import os
import sys
from collections.abc import Callable

USAGE = """\
usage: daedalus COMMAND ...

Actor-critic reinforcement learning with one learner and any number of actors, anywhere.

on this machine:
  train      start a learner and actors, watch them learn, evaluate the result
  resume     continue a run from its newest checkpoint

by hand, on any machines:
  learner    own the weights, learn from what actors send
  actor      play for a learner; needs nothing but its address
  router     stand between them, so that neither has to know the other's host
  status     show the fleet as the learner sees it
  bridge     let actors in that are written in other languages
  exporter   tell Prometheus what status tells
  certs      make the certificates for actors on machines that others reach too

afterwards:
  evaluate   play episodes with what a run has learned, or film them
  plot       draw the curves of one or more runs

for the shell:
  completion print a script that completes commands, options and presets

`daedalus COMMAND --help` tells more. To begin: daedalus train cartpole"""


def main() -> int:
    """The entry point of the console script."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(USAGE)
        return 0 if arguments else 2
    command, rest = arguments[0], arguments[1:]
    if command in _MODULES:
        # The same process becomes the other program: its signals and exit status are its own.
        os.execv(sys.executable, [sys.executable, "-P", "-m", _MODULES[command], *rest])
    if command not in _COMMANDS:
        import difflib

        near = difflib.get_close_matches(command, [*_MODULES, *_COMMANDS], 1, 0.5)
        hint = f"did you mean {near[0]}?" if near else "`daedalus --help` lists them"
        print(f"daedalus: unknown command {command!r}: {hint}", file=sys.stderr)
        return 2
    from daedalus.cli.processes import exit_on_thread_exceptions

    exit_on_thread_exceptions()
    return _COMMANDS[command](rest)


_MODULES = {name: f"daedalus.cli.commands.{name}" for name in ("learner", "actor", "evaluate", "bridge")}


def _train(arguments: list[str]) -> int:
    from daedalus.cli.commands.train import train

    return train(arguments)


def _resume(arguments: list[str]) -> int:
    from daedalus.cli.commands.train import resume

    return resume(arguments)


def _status(arguments: list[str]) -> int:
    from daedalus.cli.commands.status import status

    return status(arguments)


def _router(arguments: list[str]) -> int:
    from daedalus.cli.commands.router import router

    return router(arguments)


def _exporter(arguments: list[str]) -> int:
    from daedalus.cli.commands.exporter import exporter

    return exporter(arguments)


def _plot(arguments: list[str]) -> int:
    from daedalus.cli.commands.plot import plot

    return plot(arguments)


def _certs(arguments: list[str]) -> int:
    from daedalus.cli.commands.certs import certs

    return certs(arguments)


def _completion(arguments: list[str]) -> int:
    from daedalus.cli.commands.completion import completion

    return completion(arguments)


_COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": _train,
    "resume": _resume,
    "router": _router,
    "status": _status,
    "exporter": _exporter,
    "plot": _plot,
    "certs": _certs,
    "completion": _completion,
}
