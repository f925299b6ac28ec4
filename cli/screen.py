"""The terminal of a command: its output, which may share the screen with a live display, and the display of a training.

Rich is imported with the first frame: a run starts without it, and does without it where it is not installed.
"""

import importlib.util
import logging
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TextIO

from daedalus.launch.local_run import RunObserver
from daedalus.launch.logs import say
from daedalus.launch.supervision import Child
from daedalus.learner.reporting.progress import is_terminal
from daedalus.protocol.texts import printable

if TYPE_CHECKING:
    from daedalus.cli.run_watcher import WatchedRun


class Screen:
    """Writer of lines, above a frame that is redrawn. Several threads may use it."""

    def __init__(self, out: TextIO | None = None, err: TextIO | None = None) -> None:
        """Construct the screen of standard output and standard error, or of other streams."""
        self._out, self._err = out or sys.stdout, err or sys.stderr
        self._lock = threading.RLock()  # guards the display, and the order of what is written
        self._live: Any = None  # rich.live.Live while frames are shown
        self._ended = False

    @property
    def shows_frames(self) -> bool:
        """Whether standard output is a terminal for live displays, and rich is installed."""
        return is_terminal(self._out) and importlib.util.find_spec("rich") is not None

    def out(self, line: str) -> None:
        """Print a line on standard output. Raises OSError."""
        self._print(line, self._out)

    def err(self, line: str) -> None:
        """Print a line on standard error. Raises OSError."""
        self._print(line, self._err)

    def show(self, runs: Sequence["WatchedRun"]) -> None:
        """Show a frame in place of the one before."""
        from daedalus.cli.live_frame import frame

        self._update(lambda size, plain: frame(runs, size.width, size.height, ascii_only=plain))

    def say(self, text: str) -> None:
        """Show a line in place of a frame."""
        from rich.text import Text

        self._update(lambda *_: Text(printable(text)))

    def end(self, run: "WatchedRun | None" = None) -> None:
        """End the display. Its last frame stays, or a short one of `run`."""
        with self._lock, suppress(OSError):
            self._ended = True
            if self._live is None:
                return
            live, self._live = self._live, None
            if run is not None:
                from daedalus.cli.live_frame import summary_frame

                console = live.console
                live.update(summary_frame(run, console.size.width, ascii_only=console.options.ascii_only))
            live.stop()

    def _update(self, drawn: Callable[[Any, bool], Any]) -> None:
        with self._lock, suppress(OSError):  # a terminal that was closed
            if self._ended:
                return
            if self._live is None:
                self._live = _start_live(self._out)
            console = self._live.console
            self._live.update(drawn(console.size, console.options.ascii_only), refresh=True)

    def _print(self, line: str, stream: TextIO) -> None:
        with self._lock:
            if self._live is None or not stream.isatty():
                # In place of the line of progress that a learner rewrites on the same terminal.
                print("\r\x1b[K" if stream.isatty() else "", end="", file=stream)
                say(line, stream)
                return
            from rich.text import Text

            self._live.console.print(Text(printable(line)), soft_wrap=True)


def _start_live(stream: TextIO) -> Any:
    from rich.console import Console
    from rich.live import Live

    live = Live(
        console=Console(file=stream, highlight=False),
        auto_refresh=False,
        redirect_stdout=False,
        redirect_stderr=False,
        vertical_overflow="crop",
    )
    live.start()
    live.console.show_cursor(True)  # a process that is killed cannot bring it back
    return live


_FIRST_SECONDS = 1.0  # in which the processes of the run have the processor for themselves
_LOOK_SECONDS = 0.5  # between two frames
_CLOSE_SECONDS = 1.0

_logger = logging.getLogger(__name__)


class TrainingDisplay(RunObserver):
    """Observer that shows the training on a screen. Training does not depend on it."""

    def __init__(self, screen: Screen, run: str) -> None:
        """Construct the display. `run` is the name of the run."""
        self._screen, self._name = screen, run
        self._address = ""
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._run: WatchedRun | None = None

    @property
    def learner_options(self) -> list[str]:
        """See RunObserver. The learner shows no progress of its own."""
        return ["--no-progress"]

    def begin(self, address: str) -> None:
        """See RunObserver."""
        self._address = address

    def poll(self, learner: Child) -> bool:
        """See RunObserver. Start the display after the processes of the run."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._watch, name="display", daemon=True)
            self._thread.start()
        return False

    def end(self) -> None:
        """See RunObserver."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_CLOSE_SECONDS)  # a query of a learner that has ended may take longer
        self._screen.end(self._run)

    def _watch(self) -> None:
        if self._stop.wait(_FIRST_SECONDS):
            return
        from daedalus.cli.run_watcher import looks
        from daedalus.transport.connecting import connect  # imports zenoh

        try:
            for runs in looks(lambda: connect([self._address]), self._name, self._stop, _LOOK_SECONDS):
                if runs:  # else the learner is not there yet, or restarts
                    self._run = runs[0]
                    self._screen.show(runs)
        except Exception as error:
            _logger.warning("the display has ended: %s: %s; training continues", type(error).__name__, error)
            self._screen.end()
