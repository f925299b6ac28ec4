"""`python -m actor`: constructs one actor and runs it. Exit status: 0 the run is over, 1 failed, 2 bad usage."""

import sys
import threading
import time
from collections.abc import Callable

from actor import options
from actor.environments import UnplayableError
from actor.evaluator import Evaluator
from actor.learner_link import ActorError
from actor.service import ActorConfig, ActorService
from policy.runtime import PolicyError
from protocol.process import exit_with_parent, stop_on_signals
from protocol.transport import Transport, TransportError
from protocol.zenoh_transport import connect

_FIRST_RETRY_SECONDS, _MAX_RETRY_SECONDS = 0.02, 1.0


def main() -> int:
    """Runs `daedalus actor`."""
    arguments = options.parser().parse_args()
    try:
        config = options.config(arguments)
    except ValueError as error:
        print(f"daedalus actor: {error}", file=sys.stderr)
        return 2
    stop = stop_on_signals()
    if arguments.exit_with_parent:
        exit_with_parent(stop)

    def say(text: str) -> None:
        if not arguments.quiet:
            print(f"actor {config.name}: {text}", flush=True)

    try:
        transport = _connect(arguments.connect, config, stop, say)
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


def _connect(
    endpoints: list[str], config: ActorConfig, stop: threading.Event, say: Callable[[str], None]
) -> Transport | None:
    """Tries until the address answers; None if told to stop first."""
    deadline = None if config.timeout is None else time.monotonic() + config.timeout
    pause = _FIRST_RETRY_SECONDS
    told = False
    while True:
        try:
            return connect(endpoints)
        except TransportError as error:
            if deadline is not None and time.monotonic() > deadline:
                raise ActorError(
                    f"{error} within {config.timeout:g} s: is the learner running, and is the address its own?"
                ) from None
            if not told and pause >= 0.5:
                say(f"{error} yet; waiting for the learner")
                told = True
        if stop.wait(pause):
            return None
        pause = min(2 * pause, _MAX_RETRY_SECONDS)


if __name__ == "__main__":
    sys.exit(main())
