"""`daedalus learner`: own the weights of a run, and train them on the rollouts of actors."""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

from daedalus.cli.arguments import (
    add_allow_module,
    add_insecure,
    add_logging,
    add_reset_statistics,
    add_tls,
    allowing,
    command_parser,
    log_options,
)
from daedalus.cli.settings_arguments import add_new_run, add_settings, new_run
from daedalus.launch.learner_process import LISTEN, LearnerNetwork, LearnerOptions, LearnerProcess
from daedalus.launch.logs import print_error
from daedalus.launch.process_lifecycle import (
    BAD_USAGE,
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    raise_descriptor_limit,
    status_at_start,
    stop_on_signals,
)
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run.process_resources import keep_freed_memory, reserve_descriptors
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import ModuleNotAllowedError, UserModuleError
from daedalus.protocol.spaces import Spaces
from daedalus.transport.credentials import SECURITY_ERRORS

DESCRIPTION = """\
Owns the weights of a run. Receives rollouts from actors, trains on them, and publishes snapshots of the weights. Actors
connect to a Zenoh router inside this process. With --connect, the learner uses another router instead."""

EXAMPLES = """\
examples:
  daedalus learner cartpole
  daedalus learner cartpole --actors 8 --algorithm impala --listen tcp/127.0.0.1:7447
  daedalus learner --env Acrobot-v1 --set training.learning_rate=0.001 --run-dir runs/acrobot
  daedalus learner cartpole --listen tls/0.0.0.0:7447 --tls certs/learner      (daedalus certs --help)
  daedalus learner cartpole --connect tcp/router:7447
  daedalus learner cartpole --run-dir runs/mine --resume      (the same line for each start by systemd or Kubernetes)
  daedalus learner --run-dir runs/mine --resume --env-steps 3000000      (the whole budget, with the steps already done)

exit status: 0 the target was reached, all steps were done without a target to stop at, or a signal stopped the learner
and its checkpoint is saved; 3 the budget was used up before the target; 1 failed; 2 bad usage;
7 a newer learner of the run has taken over"""

_UPDATE_SECONDS = 120.0  # longer than one takes


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus learner`."""
    options = command_parser("learner", DESCRIPTION, EXAMPLES)
    add_settings(options)
    add_new_run(options)
    addresses = options.add_mutually_exclusive_group()
    addresses.add_argument(
        "--listen", action="append", metavar="tcp/HOST:PORT", help=f"address where actors connect (default: {LISTEN})"
    )
    addresses.add_argument(
        "--connect",
        action="append",
        metavar="tcp/HOST:PORT",
        help="address of a Zenoh router to use instead of the one inside this process",
    )
    options.add_argument(
        "--resume",
        action="store_true",
        help="continue the run in --run-dir from its newest checkpoint, or start the run if there is none. "
        "For a supervisor that repeats the same command. Another --env-steps or --set changes the run from then on",
    )
    add_reset_statistics(options, "with --resume: ")
    add_allow_module(options, "config.toml of an existing run")
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    # Options for `daedalus train`, which has created the run directory and its config.toml.
    options.add_argument("--prepared", type=Path, help=argparse.SUPPRESS)
    options.add_argument("--started", type=float, help=argparse.SUPPRESS)
    options.add_argument("--no-progress", action="store_true", help=argparse.SUPPRESS)
    options.add_argument("--rows-to", type=int, help=argparse.SUPPRESS)
    options.add_argument("--spaces", type=Spaces.model_validate_json, help=argparse.SUPPRESS)
    options.add_argument("--player-at", help=argparse.SUPPRESS)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options


def _from(here: Path, dataset: str | None) -> str | None:
    """Return a dataset that is named by a path as an absolute path."""
    return str(here / dataset) if dataset is not None and (here / dataset).is_dir() else dataset


def learner_options(arguments: argparse.Namespace, started: float, here: Path) -> LearnerOptions:
    """Return what the command line asks for.

    Args:
      arguments: the parsed command line.
      started: of this process, on the monotonic clock.
      here: the working directory, which a network or an algorithm of the user may change.
    """
    new = new_run(arguments)
    return LearnerOptions(
        new=replace(
            new,
            init_from=None if new.init_from is None else here / new.init_from,
            demonstrations=_from(here, new.demonstrations),
        ),
        here=here,
        prepared=arguments.prepared,
        resume=arguments.resume,
        reset_statistics=arguments.reset_statistics,
        allowed_modules=frozenset(arguments.allow_module),
        network=LearnerNetwork(
            listen=tuple(arguments.listen or ()),
            connect=tuple(arguments.connect or ()),
            tls=arguments.tls,
            insecure=arguments.insecure,
        ),
        log=log_options(arguments),
        trackers=tuple(arguments.log),
        shows_progress=not arguments.no_progress,
        started=arguments.started or started,
        spaces=arguments.spaces,
        player_at=arguments.player_at,
        rows_to=arguments.rows_to,
        supervised=arguments.exit_with_parent,
    )


def main() -> int:
    """Run `daedalus learner` and return its exit status."""
    started = time.monotonic()
    arguments = parser().parse_args()
    options = learner_options(arguments, started, Surroundings().directory)
    keep_freed_memory()
    raise_descriptor_limit()
    reserve_descriptors()
    # An update may take long. A disk that does not answer may hold this thread for ever.
    stop = stop_on_signals(exit_if_stuck=True, stuck_seconds=_UPDATE_SECONDS)
    user_metrics = UserMetrics()
    if options.supervised:
        exit_with_parent(stop, user_metrics.add_line)
    try:
        learner = LearnerProcess(options, stop, user_metrics)
    except ModuleNotAllowedError as error:
        print_error("learner", allowing(error, ["daedalus", "learner", *sys.argv[1:]]))
        return BAD_USAGE
    except (SettingsError, UserModuleError, *SECURITY_ERRORS) as error:
        print_error("learner", error)
        return status_at_start(error)
    return learner.run()


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(exit_status(main))
