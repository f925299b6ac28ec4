"""The processes that `daedalus actor --actors N` starts and watches: the actors, and that of their policy."""

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
from daedalus.transport.private_address import socket_folder

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.1
_LEAVE = getattr(signal, "SIGUSR1", None)  # Windows has none


class ActorGroup:
    """Actors that share a command line, and the process of their policy. An actor that has ended its work stays gone.

    An actor that fails is started again, unless it fails too often: the others then go on without it. `leave` lets all
    of them finish their rollouts.
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
        self._leave = threading.Event()
        self._leaving = False  # whether each actor has been told to leave

    def leave(self, _stop: threading.Event) -> None:
        """Let the actors finish and upload their rollouts, and end; from any thread."""
        self._leave.set()

    def run(self, stopping: threading.Event) -> int:
        """Run the actors until all have ended, or until `stopping`; return the largest of their exit statuses."""
        inference: list[Supervised] = []
        statuses = [0]
        with socket_folder() as folder:
            try:
                inference, shared = supervised_inference(self._inference, folder, self._logs.words())
                for name in self._names:
                    begin = partial(self._begin, name, shared)
                    self._actors.append(Supervised(name, begin, ended={0}, no_fault={}))
                while self._actors and not stopping.wait(_POLL_SECONDS):
                    if self._leave.is_set() and not self._leaving:
                        self._tell_to_leave()
                    for actor in list(self._actors):
                        if (status := self._ended(actor)) is not None:
                            self._actors.remove(actor)
                            statuses.append(status)
                    for each in inference:
                        _check(each)
            except FailedError as error:
                print_error("actor", error)
                statuses.append(FAILED)
            finally:
                stop([actor.process for actor in self._actors], [each.process for each in inference])
        return max(statuses)

    def _tell_to_leave(self) -> None:
        self._leaving = True
        for actor in self._actors:
            if _LEAVE is not None and actor.process.poll() is None:
                os.kill(actor.process.pid, _LEAVE)  # which kills one that has just begun to start

    def _ended(self, actor: Supervised) -> int | None:
        """Return the exit status of an actor that stays gone. Else restart it if it has died, and return None."""
        status = actor.process.poll()
        if status is not None and (status == 0 or self._leaving or actor.failed_at_once):
            return status  # it has said why
        try:
            _check(actor)
        except FailedError as error:
            print_error("actor", error)
            return FAILED
        return None

    def _begin(self, name: str, shared: Sequence[str], _first: bool) -> Child:
        words = [*self._words, "--actors", "1", "--inference", "local", "--name", name, *shared]
        with inherited(name) as streams:
            return start("daedalus.cli.commands.actor", *words, streams=streams, one_thread=True)


def _check(process: Supervised) -> None:
    if message := process.check():
        _logger.warning("%s", message)
