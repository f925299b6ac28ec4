"""`python -m actor`: constructs one actor and runs it. Exit status: 0 the run is over, 1 failed, 2 bad usage."""

import sys

from actor import options
from actor.environments import UnplayableError
from actor.evaluator import Evaluator
from actor.learner_link import ActorError
from actor.service import ActorService
from policy.runtime import PolicyError
from protocol.command_line import SECURITY_ERRORS, credentials_to_connect
from protocol.connecting import connect_when_there
from protocol.process import exit_with_parent, stop_on_signals
from protocol.transport import TransportError


def main() -> int:
    """Runs `daedalus actor`."""
    arguments = options.parser().parse_args()
    try:
        credentials = credentials_to_connect(arguments.connect, arguments.tls, "actor")
        config = options.config(arguments, credentials)
    except (ValueError, *SECURITY_ERRORS) as error:
        print(f"daedalus actor: {error}", file=sys.stderr)
        return 2
    stop = stop_on_signals()
    if arguments.exit_with_parent:
        exit_with_parent(stop)

    def say(text: str) -> None:
        if not arguments.quiet:
            print(f"actor {config.name}: {text}", flush=True)

    try:
        transport = connect_when_there(arguments.connect, stop, say, config.timeout, credentials)
        if transport is None:
            return 0
        try:
            role = Evaluator if arguments.evaluator else ActorService
            role(config, transport, stop, say).run()
        finally:
            transport.close()
    except (ActorError, UnplayableError, PolicyError, TransportError) as error:
        print(f"daedalus actor: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
