"""`daedalus actor`: construct one actor and run it.

Exit status: 0 the run is over, the actor was stopped or an operator drained it; 1 failed; 2 bad usage. With --stay,
an actor ends by a signal, a drain, wrong arguments, or after the --timeout that its user set; all other failures have
causes that somebody else can remove, so it reports them and tries again.
"""

import argparse
import logging
import secrets
import sys
import threading
from collections.abc import Callable
from dataclasses import replace

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.errors import ActorError, NoLearnerError
from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.cli.commands import actor_arguments as options
from daedalus.cli.logs import configure_logging, print_error
from daedalus.cli.processes import (
    FAILED,
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    status_at_start,
    stop_on_signals,
)
from daedalus.policy.acting.runtime import PolicyError
from daedalus.policy.user_code import frames_of, is_of_user
from daedalus.protocol.messages import Welcome
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import SECURITY_ERRORS, Credentials, NotValidNowError, credentials_to_connect
from daedalus.transport.interface import TransportError, UnreachableError
from daedalus.transport.retries import Retries

_logger = logging.getLogger("daedalus.cli")  # this module is __main__ when it runs

_REPORTED = (ActorError, EnvironmentSetupError, PolicyError, TransportError)  # each in one line
_NEXT_RUN_SECONDS = 2.0  # after a run, before the next is looked for: its learner may answer for some seconds more


def main() -> int:
    """Run `daedalus actor` and return its exit status."""
    arguments = options.parser().parse_args()
    context: dict[str, str] = {}
    configure_logging(arguments.log_level, as_json=arguments.log_json, process="actor", context=context)
    stop = stop_on_signals(exit_if_stuck=True)
    if arguments.exit_with_parent:
        exit_with_parent(stop)
    retries = Retries(stop)
    while True:
        try:
            credentials = credentials_to_connect(arguments.connect, arguments.tls, "actor")
            config = options.config(arguments, credentials)
            break
        except (ValueError, *SECURITY_ERRORS) as error:
            if not (arguments.stay and isinstance(error, NotValidNowError)):
                print_error("actor", error)
                return status_at_start(error)
            if retries.wait(str(error)):
                return 0
    context["actor"] = config.name

    def note(welcome: Welcome) -> None:
        context.update(run=welcome.run, epoch=f"{welcome.learner_epoch:x}")

    while True:
        try:
            finished = _serve_run(arguments, config, credentials, stop, note)
        except Exception as error:  # broad: see _is_of_others
            if not arguments.stay or not _is_of_others(error):
                if not isinstance(error, _REPORTED):
                    raise
                print_error("actor", error)
                return FAILED
            if not isinstance(error, _REPORTED):
                _logger.exception("a module of the run has failed")
            stopped = retries.wait(str(error) or type(error).__name__)
        else:
            if not (finished and arguments.stay):
                return 0
            retries.succeeded()
            _logger.info("waiting for the next run")
            stopped = stop.wait(_NEXT_RUN_SECONDS)
        if stopped:
            return 0
        config = replace(config, incarnation=secrets.randbits(62))


def _is_of_others(error: Exception) -> bool:
    """Return whether somebody else can remove the cause of an error, such as who started a run or renews certificates.

    Not the end of the time that the user of this actor set, and no fault of ours. A module of the run may raise
    anything.
    """
    if isinstance(error, (NoLearnerError, UnreachableError)):
        return False
    of_users = (frame for frame in frames_of(error) if is_of_user(frame))
    return isinstance(error, _REPORTED) or any(
        frame.tb_frame.f_globals.get("__name__") != "__main__" for frame in of_users
    )


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
