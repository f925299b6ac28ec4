"""`daedalus status --watch`: the state of the learners again and again."""

import threading
from collections.abc import Callable
from contextlib import suppress

from daedalus.cli.watching.run_watcher import looks
from daedalus.cli.watching.screen import Screen
from daedalus.protocol import keys
from daedalus.protocol.messages import RunStatus
from daedalus.transport.interface import Transport

_FRAME_SECONDS, _TEXT_SECONDS = 1.0, 5.0


def watch_status(
    connect: Callable[[], Transport], run: str, screen: Screen, text: Callable[[RunStatus], str], *, frames: bool
) -> None:
    """Show the runs until Ctrl-C.

    Args:
      connect: opens the transport. Raises TransportError.
      run: name of the run, or `*` for all runs.
      screen: where to show them.
      text: returns what is printed about a run where no frames are shown.
      frames: redraw one frame.

    Raises TransportError if the learner refuses this process, or if its answers are damaged.
    """
    wanted = "no learner" if run == keys.ANY_RUN else f"no learner of run {run!r}"
    nobody, waiting = f"{wanted} answers at this address; waiting for one (Ctrl-C ends)", False
    with suppress(KeyboardInterrupt):
        try:
            for runs in looks(connect, run, threading.Event(), _FRAME_SECONDS if frames else _TEXT_SECONDS):
                if frames and runs:
                    screen.show(runs)
                elif frames:
                    screen.say(nobody)
                elif not runs and not waiting:
                    screen.err(f"daedalus status: {nobody}")
                for each in runs if not frames else ():
                    screen.out(text(each.status))
                waiting = not runs
        finally:
            screen.end()
