"""`daedalus actor`: play environments for a learner."""

import argparse
import sys
from typing import NoReturn

from daedalus.actor.session.actor_config import own_name
from daedalus.cli.arguments import (
    add_allow_module,
    add_connect,
    add_inference,
    add_logging,
    add_tls,
    command_parser,
    log_options,
    seconds,
)
from daedalus.launch.actor_process import ActorGroup, ActorOptions, LeaveRequest, run_actor
from daedalus.launch.logs import print_error
from daedalus.launch.process_lifecycle import (
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    status_at_start,
    stop_on_signals,
)
from daedalus.launch.supervision import check_inference
from daedalus.protocol import keys
from daedalus.transport.credentials import SECURITY_ERRORS, credentials_to_connect

_MOST_ACTORS = 1024

DESCRIPTION = """\
Plays environments and sends rollouts to a learner. An actor needs one address: the environment, the network and all
settings come from the learner. An actor may start before the learner, and may join or leave at any time."""

EXAMPLES = """\
examples:
  daedalus actor --connect tcp/127.0.0.1:7447
  daedalus actor --connect tcp/gpu-box:7447 --envs 32 --name arm-3
  daedalus actor --connect tcp/gpu-box:7447 --actors 16      (16 actors of this machine)
  daedalus actor --connect tls/gpu-box:7447 --tls actor-arm-3
  daedalus actor --connect tcp/gpu-box:7447 --allow-module corridor      (the run plays corridor:Corridor-v0)
  daedalus actor --connect tcp/127.0.0.1:7447 --evaluator
  daedalus actor --connect tcp/router:7447 --stay      (serves one run after another)
  daedalus actor --connect tcp/router:7447 --seat adversary=tag-adversary --seat agent=tag-agent

signals: SIGTERM and SIGINT end an actor after the current step; its unfinished rollout is lost. SIGUSR1 is for a host
that is about to end: the actor finishes its rollout, uploads it, and ends within 30 s with exit status 0. A rollout
that takes longer is dropped, and the log says how much is lost.

exit status: 0 the run is over, the actor was stopped or an operator drained it; 1 failed; 2 bad usage. With --stay an
actor ends by a signal, a drain, wrong arguments or its --timeout; after any other failure it tries again"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus actor`."""
    options = command_parser("actor", DESCRIPTION, EXAMPLES)
    add_connect(options)
    options.add_argument(
        "--envs",
        type=int,
        metavar="E",
        help="number of environments to step together (default: as the learner asks)",
    )
    options.add_argument(
        "--actors",
        type=int,
        default=1,
        metavar="N",
        help="number of actors to start, with --name as NAME.1 to NAME.N. One that ends is started again, unless it "
        "is done or fails in its first minute (default: %(default)s)",
    )
    add_inference(options)
    options.add_argument("--inference-at", metavar="PATH", help=argparse.SUPPRESS)  # for the actors of a group
    add_allow_module(options, "the learner")
    options.add_argument(
        "--runtime",
        choices=("onnx", "torch"),
        help="library that runs the policy (default: onnx, which needs no torch; torch with --inference cuda)",
    )
    _add_connection(options)
    options.add_argument(
        "--evaluator",
        action="store_true",
        help="play the evaluations of the run on its schedule and report the returns, instead of sending rollouts",
    )
    options.add_argument(
        "--stay",
        action="store_true",
        help="wait for the next run when a run is over, and try again after a failure that others may remove, such as "
        "a module that a run needs, instead of ending. `daedalus drain` or a signal ends the actor",
    )
    add_tls(options)
    add_logging(options)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options


def _add_connection(options: argparse.ArgumentParser) -> None:
    """Add the options about the learner, the name and the link."""
    runs = options.add_mutually_exclusive_group()
    runs.add_argument(
        "--run",
        default=keys.ANY_RUN,
        metavar="NAME",
        help="run to join, if several runs share a network (default: the only run; the actor then stays with this run)",
    )
    runs.add_argument(
        "--any-run", action="store_true", help="change to another run when the learner of the present one has gone"
    )
    options.add_argument(
        "--seat",
        action="append",
        default=[],
        type=_seat,
        metavar="ROLE=RUN",
        help="let the policy of a run play a role of a game (adversary stands for adversary_0, adversary_1 and so on), "
        "or one agent. Give it for each role: the actor joins all these runs. In place of a run that is over, its run "
        "directory: its newest policy plays, and does not learn",
    )
    options.add_argument(
        "--name",
        metavar="NAME",
        help="name of this actor. Keep it after a restart (default: made from the name of the host)",
    )
    options.add_argument(
        "--link",
        choices=("auto", "lan", "wan"),
        default="auto",
        help="lan: fetch whole snapshots. wan: fetch snapshots as bfloat16 differences, as often as the link "
        "allows (default: %(default)s, which measures the link, unless it is a Unix socket)",
    )
    options.add_argument(
        "--timeout",
        type=seconds,
        metavar="SECONDS",
        help="time to look for a learner before giving up (default: no limit)",
    )


def _seat(text: str) -> tuple[str, str]:
    name, equals, run = text.partition("=")
    if not (name and equals and run):
        raise argparse.ArgumentTypeError(f"{text!r} is not ROLE=RUN, such as adversary=tag-adversary")
    return name, run


def actor_options(arguments: argparse.Namespace) -> ActorOptions:
    """Return what the command line asks for."""
    return ActorOptions(
        connect=arguments.connect,
        tls=arguments.tls,
        evaluator=arguments.evaluator,
        stay=arguments.stay,
        name=arguments.name,
        run=arguments.run,
        any_run=arguments.any_run,
        seats=tuple(arguments.seat),
        environments=arguments.envs,
        runtime=arguments.runtime or "onnx",
        inference_at=arguments.inference_at,
        link=arguments.link,
        timeout=arguments.timeout,
        allowed_modules=frozenset(arguments.allow_module),
    )


def main() -> int:
    """Run `daedalus actor` and return its exit status."""
    arguments = parser().parse_args()
    context: dict[str, str] = {}
    log_options(arguments).configure(process="actor", context=context)
    if arguments.actors != 1 or arguments.inference != "local":
        return _run_group(arguments)
    leave = LeaveRequest()
    stop = stop_on_signals(exit_if_stuck=True, on_leave=leave.ask)
    if arguments.exit_with_parent:
        exit_with_parent(stop)
    return run_actor(actor_options(arguments), stop, context, leave)


def _run_group(arguments: argparse.Namespace) -> int:
    try:
        if not 1 <= arguments.actors <= _MOST_ACTORS:
            raise ValueError(f"--actors is {arguments.actors}: choose a number from 1 to {_MOST_ACTORS}")
        if arguments.evaluator and arguments.inference != "local":
            raise ValueError("--inference is for actors, and an evaluator runs its own policy: leave it out")
        if arguments.inference == "cuda" and arguments.runtime == "onnx":
            raise ValueError("--inference cuda runs the policy with torch: leave out --runtime onnx")
        check_inference(arguments.inference)
        credentials = credentials_to_connect(arguments.connect, arguments.tls, "actor")
        identity, numbers = credentials.name if credentials else "", range(1, arguments.actors + 1)
        names = [f"{arguments.name}.{each}" if arguments.name else own_name(identity, each) for each in numbers]
    except (ValueError, *SECURITY_ERRORS) as error:
        print_error("actor", error)
        return status_at_start(error)
    group = ActorGroup(sys.argv[1:], names, arguments.inference, log_options(arguments))
    stop = stop_on_signals(exit_if_stuck=True, on_leave=group.leave)
    if arguments.exit_with_parent:
        exit_with_parent(stop)
    return group.run(stop)


def run_process() -> NoReturn:
    """Run the command of this process, and end it."""
    exit_on_thread_exceptions(plays=True)
    sys.exit(exit_status(main))


if __name__ == "__main__":
    run_process()
