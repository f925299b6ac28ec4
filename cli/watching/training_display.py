"""Live display of `daedalus train`: the newest status of the run, from a thread of its own."""

import logging
import subprocess
import threading

from daedalus.cli.running.run_observer import RunObserver
from daedalus.cli.watching.screen import Screen
from daedalus.cli.watching.watched_run import WatchedRun

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

    def poll(self, learner: subprocess.Popen[bytes]) -> bool:
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
        from daedalus.cli.watching.run_watcher import looks
        from daedalus.transport.connecting import connect  # imports zenoh

        try:
            for runs in looks(lambda: connect([self._address]), self._name, self._stop, _LOOK_SECONDS):
                if runs:  # else the learner is not there yet, or restarts
                    self._run = runs[0]
                    self._screen.show(runs)
        except Exception as error:
            _logger.warning("the display has ended: %s: %s; training continues", type(error).__name__, error)
            self._screen.end()
