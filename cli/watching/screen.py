"""Standard output and standard error of a command, which may share the terminal with a live display.

Rich is imported with the first frame: a run starts without it, and does without it where it is not installed.
"""

import importlib.util
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TextIO

from daedalus.cli.logs import say
from daedalus.cli.watching.watched_run import WatchedRun
from daedalus.learner.reporting.progress import is_terminal
from daedalus.protocol.texts import printable


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

    def show(self, runs: Sequence[WatchedRun]) -> None:
        """Show a frame in place of the one before."""
        from daedalus.cli.watching.frame import frame

        self._update(lambda size, plain: frame(runs, size.width, size.height, ascii_only=plain))

    def say(self, text: str) -> None:
        """Show a line in place of a frame."""
        from rich.text import Text

        self._update(lambda *_: Text(printable(text), no_wrap=True, overflow="ellipsis"))

    def end(self, run: WatchedRun | None = None) -> None:
        """End the display. Its last frame stays, or a short one of `run`."""
        with self._lock, suppress(OSError):
            self._ended = True
            if self._live is None:
                return
            live, self._live = self._live, None
            if run is not None:
                from daedalus.cli.watching.frame import summary_frame

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
