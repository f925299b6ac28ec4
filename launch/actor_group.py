"""Several actors of one command (`daedalus actor --actors N`), as supervised processes."""

import logging
import os
import signal
import threading
from collections.abc import Sequence
from functools import partial

from daedalus.launch.child_output import inherited
from daedalus.launch.logs import LogOptions, print_error
from daedalus.launch.process_lifecycle import FAILED
from daedalus.launch.supervision import (
    Child,
    FailedError,
    Inference,
    Supervised,
    start,
    stop,
    supervised_inference,
)
from daedalus.transport.private_address import private_folder

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.1
_LEAVE = getattr(signal, "SIGUSR1", None)  # Windows has none


class ActorGroup:
    """Actors that share a command line, and the process of their policy. An actor that has ended its work stays gone.

    An actor that fails is started again. `leave` lets all of them finish their rollouts.
    """

    def __init__(self, words: Sequence[str], names: Sequence[str], inference: Inference, logs: LogOptions) -> None:
        """Start no process yet.

        Args:
          words: the command line of each actor, without its name.
          names: of the actors.
          inference: where their policies run.
          logs: how the inference process logs.
        """
        self._words, self._names, self._logs = words, names, logs
        self._inference: Inference = inference
        self._actors: list[Supervised] = []

    def leave(self, _stop: threading.Event) -> None:
        """Let the actors finish and upload their rollouts, and end."""
        for actor in list(self._actors):
            if _LEAVE is not None and actor.process.poll() is None:
                os.kill(actor.process.pid, _LEAVE)

    def run(self, stopping: threading.Event) -> int:
        """Run the actors until all have ended, or until `stopping`; return the largest of their exit statuses."""
        inference: list[Supervised] = []
        statuses = [0]
        with private_folder() as folder:
            try:
                inference, shared = supervised_inference(self._inference, folder, self._logs.words())
                for name in self._names:
                    begin = partial(self._begin, name, shared)
                    self._actors.append(Supervised(name, begin, ended={0}, no_fault={}))
                while self._actors and not stopping.wait(_POLL_SECONDS):
                    for process in [*self._actors, *inference]:
                        status = process.process.poll()
                        if process in self._actors and (status == 0 or process.failed_at_once):
                            self._actors.remove(process)  # it has said why
                            statuses.append(status or 0)
                        elif message := process.check():
                            _logger.warning("%s", message)
            except FailedError as error:
                print_error("actor", error)
                statuses.append(FAILED)
            finally:
                stop([actor.process for actor in self._actors])
                stop([each.process for each in inference])
        return max(statuses)

    def _begin(self, name: str, shared: Sequence[str], _first: bool) -> Child:
        words = [*self._words, "--actors", "1", "--inference", "local", "--name", name, *shared]
        with inherited(name) as streams:
            return start("daedalus.cli.commands.actor", *words, streams=streams, one_thread=True)
