"""`daedalus actor`: construct one actor and run it.

Exit status: 0 the run is over, the actor was stopped or an operator drained it; 1 failed; 2 bad usage.
"""

import argparse
import logging
import secrets
import sys
import threading
from collections.abc import Callable
from dataclasses import replace

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.errors import ActorError
from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.config import ActorConfig
from daedalus.actor.session.service import ActorService
from daedalus.cli.commands import actor_arguments as options
from daedalus.cli.logs import configure_logging, print_error
from daedalus.cli.processes import exit_on_thread_exceptions, exit_status, exit_with_parent, stop_on_signals
from daedalus.policy.acting.runtime import PolicyError
from daedalus.protocol.messages import Welcome
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import Credentials
from daedalus.transport.interface import TransportError
from daedalus.transport.security import SECURITY_ERRORS, credentials_to_connect

_logger = logging.getLogger("daedalus.cli")  # this module is __main__ when it runs

_NEXT_RUN_SECONDS = 2.0  # after a run, before the next is looked for: its learner may answer for some seconds more


def main() -> int:
    """Run `daedalus actor` and return its exit status."""
    arguments = options.parser().parse_args()
    try:
        credentials = credentials_to_connect(arguments.connect, arguments.tls, "actor")
        config = options.config(arguments, credentials)
    except (ValueError, *SECURITY_ERRORS) as error:
        print_error("actor", error)
        return 2
    stop = stop_on_signals(exit_if_stuck=True)
    if arguments.exit_with_parent:
        exit_with_parent(stop)

    context = {"actor": config.name}
    configure_logging(arguments.log_level, as_json=arguments.log_json, process="actor", context=context)

    def note(welcome: Welcome) -> None:
        context.update(run=welcome.run, epoch=f"{welcome.learner_epoch:x}")

    try:
        while _serve_run(arguments, config, credentials, stop, note) and arguments.stay:
            _logger.info("waiting for the next run")
            if stop.wait(_NEXT_RUN_SECONDS):
                break
            config = replace(config, incarnation=secrets.randbits(62))
    except (ActorError, EnvironmentSetupError, PolicyError, TransportError) as error:
        print_error("actor", error)
        return 1
    return 0


def _serve_run(
    arguments: argparse.Namespace,
    config: ActorConfig,
    credentials: Credentials | None,
    stop: threading.Event,
    on_join: Callable[[Welcome], None],
) -> bool:
    """Take part in one run; return whether the run finished. Raises what `main` reports."""
    transport = connect_with_retry(arguments.connect, stop, config.timeout, credentials)
    if transport is None:
        return False
    try:
        role = Evaluator if arguments.evaluator else ActorService
        return role(config, transport, stop, on_join=on_join).run()
    finally:
        transport.close()


if __name__ == "__main__":
    exit_on_thread_exceptions(plays=True)
    sys.exit(exit_status(main))
