"""What the processes that play for a gateway's page have in common: their start and end, their input and output.

They have no network: see gateway/watching/playing_process.py for their messages. They run at the lowest priority. Exit
status: 0 the gateway has closed its input or stopped the process, 1 failed.
"""

import argparse
import json
import os
import queue
import sys
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn, TextIO

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.gateway.watching.playing_process import LENGTH, note
from daedalus.launch.logs import configure_logging
from daedalus.launch.process_lifecycle import (
    exit_on_thread_exceptions,
    exit_status,
    reserved_stdout,
    stop_on_signals,
)
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.user_code import first_line
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.messages import Message, Program, Snapshot, Welcome

_NICENESS = 19
_READ_BYTES = 1 << 20
_MOST_ORDERS = 64  # that wait


class GatewayPipes:
    """The pipes to and from the gateway, whose messages a thread of its own reads.

    Attributes:
      stop: set when the gateway closes the input, or by a signal.
      newest: the newest snapshot.
      orders: maps that came as JSON. A snapshot that came before an order is `newest` when the order is taken.
    """

    def __init__(self, output: TextIO, stop: threading.Event) -> None:
        self._output, self.stop = output, stop
        self._descriptor = sys.stdin.fileno()  # not a buffered stream, whose lock the thread would hold
        self.newest: Snapshot | None = None
        self.orders: queue.Queue[dict[str, Any]] = queue.Queue(_MOST_ORDERS)

    def begin(self) -> tuple[Welcome, Program]:
        """Return the first two messages, and read the others from then on. Raises EOFError or ProtocolError."""
        welcome, program = self._read(), self._read()
        if not isinstance(welcome, Welcome) or not isinstance(program, Program):
            raise ProtocolError("the first messages are no Welcome and Program")
        self._keep()
        threading.Thread(target=self._follow, name="input", daemon=True).start()
        return welcome, program

    def _follow(self) -> None:
        try:
            while True:
                self._keep()
        except EOFError:
            self.stop.set()

    def _keep(self) -> None:
        message = self._read()
        if isinstance(message, Snapshot):
            self.newest = message
        elif isinstance(message, dict):
            self.orders.put(message)

    def _read(self) -> Message | dict[str, Any]:
        (length,) = LENGTH.unpack(self._exactly(LENGTH.size))
        if length > LEARNER_LIMITS.message_bytes:
            raise ProtocolError(f"a message of {length} bytes")
        data = self._exactly(length)
        return json.loads(data) if data.startswith(b"{") else decode(data, LEARNER_LIMITS)

    def _exactly(self, length: int) -> bytes:
        data = bytearray()
        while len(data) < length:
            part = os.read(self._descriptor, min(length - len(data), _READ_BYTES))
            if not part:
                raise EOFError
            data += part
        return bytes(data)

    def write(self, frame: bytes) -> None:
        """Write a frame now."""
        self._output.buffer.write(LENGTH.pack(len(frame)) + frame)
        self._output.flush()


Play = Callable[[GatewayPipes, UserModules, argparse.Namespace], int]


def run_player(process: str, failure: str, play: Play, options: argparse.ArgumentParser) -> NoReturn:
    """Run a process that plays, and end it.

    Args:
      process: its kind, for the log.
      failure: what the page shows before the reason of a failure.
      play: plays until the gateway stops the process, and returns the exit status.
      options: its command line.
    """
    exit_on_thread_exceptions(plays=True)
    sys.exit(exit_status(partial(_main, process, failure, play, options)))


def _main(process: str, failure: str, play: Play, options: argparse.ArgumentParser) -> int:
    output = reserved_stdout()
    options.add_argument("--allow-module", action="append", default=[])
    arguments = options.parse_args()
    configure_logging("warning", process=process)
    if hasattr(os, "nice"):  # not on Windows
        os.nice(_NICENESS)
    gateway = GatewayPipes(output, stop_on_signals(exit_if_stuck=True))
    try:
        return play(gateway, UserModules(frozenset(arguments.allow_module), "the run"), arguments)
    except EOFError:
        return 0
    except (EnvironmentSetupError, PolicyError, ProtocolError) as error:
        if not gateway.stop.is_set():
            gateway.write(note(f"{failure}: {error}"))
        return 1
    except Exception as error:  # of an environment's own renderer, such as OpenGL without a driver
        gateway.write(note(f"{failure}: {type(error).__name__}: {first_line(error)}"))
        raise
