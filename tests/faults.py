"""Faults for tests: connections that stall or are slow, a sender of arbitrary rollouts, and processes that crash."""

import contextlib
import queue
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from plain import ACTION, NAME, vector_spaces
from processes import Running

from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import Conversation
from daedalus.actor.session.session_thread import SessionThread
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Snapshot, Welcome
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.zenoh_transport import connect

CARTPOLE = vector_spaces(4, 2)
ANSWER_SECONDS = 60.0


def port_of(address: str) -> int:
    """Return the port of tcp/HOST:PORT."""
    return int(address.rsplit(":", 1)[1])


class StallingProxy:
    """TCP proxy that can stall: the connections then stay open and no byte is forwarded."""

    def __init__(self, target: str) -> None:
        self._target = port_of(target)
        self._flowing = threading.Event()
        self._flowing.set()
        self._closed = False
        self._sockets: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def stall(self) -> None:
        """Stop forwarding without an error, as if a cable was pulled. New connections are not served either."""
        self._flowing.clear()

    def resume(self) -> None:
        """Forward all bytes again, also those that were held back."""
        self._flowing.set()

    def close(self) -> None:
        """Close all connections."""
        self._closed = True
        self._flowing.set()
        for each in [self._listener, *self._sockets]:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        while not self._closed:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self._sockets.append(near)
            threading.Thread(target=self._connect, args=(near,), daemon=True).start()

    def _connect(self, near: socket.socket) -> None:
        self._flowing.wait()
        try:
            far = socket.create_connection(("127.0.0.1", self._target))
        except OSError:
            near.close()
            return
        self._sockets.append(far)
        for ends in ((near, far), (far, near)):
            threading.Thread(target=self._pump, args=ends, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                self._flowing.wait()
                sink.sendall(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


class SlowProxy:
    """TCP proxy with a limited rate in each direction and a delay."""

    def __init__(self, target: str, *, up: float, down: float, delay: float) -> None:
        """Start the proxy. `up` and `down` are in bytes per second, `delay` in seconds in each direction."""
        self._target, self._rates, self._delay = port_of(target), {"up": up, "down": down}, delay
        self.carried = {"up": 0, "down": 0}  # bytes
        self._sockets: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._spawn(self._accept)

    def _spawn(self, work: Callable[..., None], *arguments: object) -> None:
        threading.Thread(target=work, args=arguments, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            try:
                far = socket.create_connection(("127.0.0.1", self._target))
            except OSError:
                near.close()
                continue
            self._sockets += (near, far)
            for way, source, sink in (("up", near, far), ("down", far, near)):
                # Small buffers, as on a slow link: larger ones would take the first megabytes at once.
                source.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 64 << 10)
                passing: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
                self._spawn(self._read, way, source, passing)
                self._spawn(self._write, sink, passing)

    def _read(self, way: str, source: socket.socket, passing: "queue.SimpleQueue[tuple[float, bytes]]") -> None:
        free_at, data = time.monotonic(), b" "
        while data:
            try:
                data = source.recv(8 << 10)
            except OSError:
                data = b""
            free_at = max(free_at, time.monotonic()) + len(data) / self._rates[way]
            time.sleep(max(free_at - time.monotonic(), 0.0))
            self.carried[way] += len(data)
            passing.put((free_at + self._delay, data))

    def _write(self, sink: socket.socket, passing: "queue.SimpleQueue[tuple[float, bytes]]") -> None:
        with contextlib.suppress(OSError):
            while True:
                at, data = passing.get()
                time.sleep(max(at - time.monotonic(), 0.0))
                if not data:
                    sink.shutdown(socket.SHUT_RDWR)
                    return
                sink.sendall(data)

    def close(self) -> None:
        """Close all connections."""
        for end in (self._listener, *self._sockets):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()


class Sender:
    """Client that joins a CartPole run as an actor and sends the rollouts of a test."""

    def __init__(self, address: str, name: str, environments: int = 2) -> None:
        self.transport = connect([address])
        self.name, self.environments, self.incarnation = name, environments, secrets.randbits(62)
        self._talk = Conversation(ActorConfig(name=name, incarnation=self.incarnation, timeout=ANSWER_SECONDS))
        self._thread = SessionThread(self._talk, self.transport, threading.Event())
        found = self._thread.run(self._talk.find_learner())
        join = replace(self._talk.join, spaces=CARTPOLE, environments=environments)
        self.welcome: Welcome = self._thread.run(self._talk.confirm(found, join))
        self.key = keys.rollouts(self.welcome.run, name)

    def version(self) -> int:
        """Return the newest policy version, or 0 before the first."""
        messages = self._thread.run(self._talk.ask(keys.snapshots(self.welcome.run)))
        newest = [message for message in messages if isinstance(message, Snapshot)]
        return newest[0].policy_version if newest else 0

    def rollout(self, sequence: int, version: int, **changed: Any) -> bytes:
        """Return an encoded rollout of plausible values, with the given fields changed."""
        random = np.random.default_rng(sequence)
        shape = (self.welcome.spec.collection.rollout_length, self.environments)
        content: dict[str, Any] = {
            "frames": {NAME: random.normal(0, 0.05, (shape[0] + 1, self.environments, 4)).astype(np.float32)},
            "initial_state": np.zeros((self.environments, 0), np.float32),
            "actions": {ACTION: random.integers(0, 2, (*shape, 1)).astype(np.uint8)},
            "masks": {},
            "behaviour_log_probs": np.full(shape, np.log(0.5), np.float32),
            "rewards": np.ones(shape, np.float32),
            "terminated": np.zeros(shape, np.bool_),
            "truncated": np.zeros(shape, np.bool_),
            "valid": np.ones(shape, np.bool_),
            "episode_returns": np.zeros(0, np.float32),
            "episode_lengths": np.zeros(0, np.int32),
        }
        identity = RolloutIdentity(
            actor=self.name,
            incarnation=self.incarnation,
            sequence=sequence,
            learner_epoch=self.welcome.learner_epoch,
        )
        return encode(Rollout(identity=identity, policy_version=version, **{**content, **changed}))

    def send(self, payload: bytes) -> Acknowledgement:
        """Send bytes as a rollout and return the answer of the learner."""
        (answer,) = self.transport.query(self.key, payload, timeout=ANSWER_SECONDS)
        message = decode(answer, Limits())
        assert isinstance(message, Acknowledgement)
        return message

    def close(self) -> None:
        """Close the connection."""
        self.transport.close()


class Faulty:
    """A command in which one function raises."""

    def __init__(self, directory: Path, command: str, fault: str, *arguments: object) -> None:
        module, _, target = fault.partition(":")
        program = "\n".join(
            [
                "import importlib, runpy, sys",
                f"module = importlib.import_module({module!r})",
                "def fail(*arguments, **options): raise RuntimeError('a fault of ours')",
                f"module.{target} = fail",
                f"sys.argv = [{command!r}, *{[str(argument) for argument in arguments]!r}]",
                f"runpy.run_module('daedalus.cli.commands.{command}', run_name='__main__', alter_sys=True)",
            ]
        )
        self._running = Running([sys.executable, "-P", "-c", program], directory)

    def assert_crashes(self) -> None:
        """Its process ends with status 1 and a traceback."""
        try:
            assert self._running.wait() == 1
            assert "Traceback" in self._running.output
            assert "RuntimeError: a fault of ours" in self._running.output
        finally:
            self._running.end()
