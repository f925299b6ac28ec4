"""`python -m daedalus.cli.tracking.process NAME RUN_DIR`: log a run to a tracker until standard input ends.

Exit status: 0 everything was logged; 1 otherwise.
"""

import argparse
import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from daedalus.cli.logs import configure_logging, say
from daedalus.cli.processes import exit_on_thread_exceptions, exit_with_parent, stop_on_signals
from daedalus.learner.reporting.trackers.tracker import tracker_class, tracker_name
from daedalus.learner.reporting.trackers.tracking import Tracking
from daedalus.learner.run.run_directory import run_name
from daedalus.policy.user_code import first_line, place_of
from daedalus.policy.user_modules import UserModuleError

_END_SECONDS = 60.0  # after the end of the run; a parent that lives ends this process before


def main() -> int:
    """Run the process and return its exit status."""
    options = argparse.ArgumentParser()
    options.add_argument("name", type=tracker_name)
    options.add_argument("directory", type=Path)
    options.add_argument("--service", action="store_true")
    options.add_argument("--log-json", action="store_true")
    options.add_argument("--exit-with-parent", action="store_true")
    parsed = options.parse_args()
    process, context = "tracker" if parsed.service else "", {"run": run_name(parsed.directory)}
    configure_logging(as_json=parsed.log_json, process=process, context=context, write=_own_output())
    finish = stop_on_signals()
    exit_with_parent(finish)
    threading.Thread(target=_end_in_time, args=(finish,), name="end", daemon=True).start()
    try:
        open_tracker = tracker_class(parsed.name)
    except Exception as error:  # the user's module may raise anything
        fault = str(error) if isinstance(error, UserModuleError) else f"{first_line(error)}{place_of(error)}"
        logging.getLogger("daedalus.cli.tracking").warning("%s: %s; the run goes on without it", parsed.name, fault)
        return 1
    done = Tracking(parsed.name, parsed.directory, open_tracker, finish).run()
    os._exit(0 if done else 1)  # packages of trackers wait for the network at the end of the interpreter


def _own_output() -> Callable[[str], None]:
    """Return a function that prints a line on standard output. What packages print goes to standard error."""
    own = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8", errors="backslashreplace")
    sys.stdout.flush()
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return lambda line: say(line, own)


def _end_in_time(finish: threading.Event) -> None:
    finish.wait()
    time.sleep(_END_SECONDS)
    os._exit(1)


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(main())
