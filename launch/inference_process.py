"""The process that runs the policy of all actors of one command (`--inference shared`). See SharedRuntime.

It chooses the actions of all actors that wait, in as few calls as possible: one for each version of the policy that
they use. The busier it is, the more actors wait, and the larger the calls.
"""

import argparse
import json
import os
import selectors
import socket
import sys
import threading
import weakref
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NoReturn

import numpy as np

from daedalus.launch.logs import configure_logging
from daedalus.launch.process_lifecycle import (
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    raise_descriptor_limit,
    stop_on_signals,
)
from daedalus.policy.acting.noise import Noise
from daedalus.policy.acting.program_check import MAX_PROGRAM_BYTES, PolicyError
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.policy.acting.shared_runtime import PACKET_BYTES, Region
from daedalus.policy.user_code import message_line
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import LearningSpec
from daedalus.transport.process_usage import available_processors

_MAX_ROWS = 256  # in one call, unless one actor has more: its memory is limited
_POLL_SECONDS = 0.2


@dataclass(slots=True, eq=False)
class _Version:
    """Weights in a runtime, and the actors that use them."""

    runtime: PolicyRuntime
    weights: dict[str, np.ndarray]
    users: int = 0

    def has(self, weights: Mapping[str, np.ndarray]) -> bool:
        """Return whether the weights are these, as they are for actors that have the same snapshot."""
        return self.weights.keys() == weights.keys() and all(
            np.array_equal(values, weights[name]) for name, values in self.weights.items()
        )


class _Policy:
    """One policy, in the versions that actors use."""

    def __init__(self, make: Callable[[], PolicyRuntime]) -> None:
        self._make, self._spare = make, [make()]
        self._versions: list[_Version] = []  # the newest last
        self.sizes = {
            "state": self._spare[0].state_size,
            "uniform": self._spare[0].noise_size.uniform,
            "normal": self._spare[0].noise_size.normal,
            "explores": self._spare[0].explores,
        }

    def version(self, weights: Mapping[str, np.ndarray]) -> _Version:
        """Return the version with these weights for one more actor. Raises PolicyError if they do not fit."""
        for version in reversed(self._versions):
            if version.has(weights):
                break
        else:
            runtime = self._spare.pop() if self._spare else self._make()
            version = _Version(runtime, {name: values.copy() for name, values in weights.items()})
            runtime.load(version.weights)
            self._versions.append(version)
        version.users += 1
        return version

    def release(self, version: _Version) -> None:
        """Note that an actor does not use a version any more."""
        version.users -= 1
        if not version.users:
            self._versions.remove(version)
            self._spare.append(version.runtime)


@dataclass(slots=True, eq=False)
class _Actor:
    """The other end of a SharedRuntime."""

    socket: socket.socket
    policy: _Policy | None = None
    region: Region | None = None
    version: _Version | None = None
    rows: int = 0  # that wait for actions

    def answer(self, what: Mapping[str, Any]) -> None:
        """Answer a packet. The socket of an actor that has died says so when it is read."""
        with suppress(OSError):
            self.socket.send(json.dumps(what).encode())


@dataclass(slots=True)
class Inference:
    """The policies of the actors of this machine. Call `serve`.

    Attributes:
      device: where torch runs; programs run on the CPU.
      threads: of a call of a policy.
    """

    device: str
    threads: int
    stop: threading.Event
    _selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)
    _policies: weakref.WeakValueDictionary[tuple[bytes, bytes], _Policy] = field(
        default_factory=weakref.WeakValueDictionary
    )

    def serve(self, path: str) -> None:
        """Serve actors at a Unix socket until `stop`."""
        with suppress(FileNotFoundError):
            os.unlink(path)  # of the process before, which has died
        with closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as listener, self._selector:
            listener.bind(path)
            listener.listen(1024)
            self._selector.register(listener, selectors.EVENT_READ)
            while not self.stop.is_set():
                waiting: list[_Actor] = []
                for key, _ in self._selector.select(_POLL_SECONDS):
                    if key.data is None:
                        connection, _ = listener.accept()
                        connection.setblocking(False)
                        self._selector.register(connection, selectors.EVENT_READ, _Actor(connection))
                    elif self._read(key.data):
                        waiting.append(key.data)
                self._act(waiting)

    def _read(self, actor: _Actor) -> bool:
        """Do what an actor's packet says; return whether it waits for actions."""
        try:
            packet, descriptors, _, _ = socket.recv_fds(actor.socket, PACKET_BYTES, 1)
        except OSError:  # it has died
            packet, descriptors = b"", []
        if not packet:
            self._forget(actor)
            return False
        try:
            match packet.decode().split():
                case ["begin"]:
                    actor.policy = self._policy(Region.open(descriptors[0]))
                    actor.answer(actor.policy.sizes)
                case ["region"]:
                    actor.region = Region.open(descriptors[0])
                    actor.answer({})
                case ["load"] if actor.policy is not None and actor.region is not None:
                    before, weights = actor.version, actor.region.named("weights/")
                    actor.version = actor.policy.version(weights)
                    if before is not None:
                        actor.policy.release(before)
                    actor.answer({})
                case ["act", rows] if actor.version is not None and actor.region is not None:
                    actor.rows = int(rows)
                    if not 0 < actor.rows <= len(actor.region.arrays["out/log_prob"]):
                        raise ValueError(f"an actor asks for {rows} rows")
                    return True
                case _:
                    raise ValueError(f"unexpected packet {packet[:40]!r}")
        except (PolicyError, ValueError, TypeError, LookupError) as error:
            actor.answer(_refusal(error))
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        return False

    def _policy(self, setup: Region) -> _Policy:
        """Return the policy of a setup; the actors of one run share it. Raises PolicyError, ValueError."""
        made, program = setup.arrays["setup"].tobytes(), setup.arrays["program"][: MAX_PROGRAM_BYTES + 1].tobytes()
        policy = self._policies.get((made, program))
        if policy is None:
            policy = self._policies[made, program] = _Policy(self._maker(json.loads(made), program))
        return policy

    def _maker(self, setup: Mapping[str, Any], program: bytes) -> Callable[[], PolicyRuntime]:
        if program:
            return OnnxRuntime(program, self.stop, threads=self.threads).fork
        from daedalus.policy.acting.torch_runtime import TorchRuntime  # the only part with torch

        learning, spaces = LearningSpec.model_validate(setup["learning"]), Spaces.model_validate(setup["spaces"])
        make = partial(TorchRuntime, learning.policy, spaces, learning.training)
        return partial(make, device=self.device, threads=self.threads)

    def _act(self, waiting: list[_Actor]) -> None:
        """Choose the actions of actors, and answer them."""
        batches: dict[_Version, list[list[_Actor]]] = {}
        for actor in waiting:
            assert actor.version is not None
            chunks = batches.setdefault(actor.version, [[]])
            if chunks[-1] and sum(each.rows for each in chunks[-1]) + actor.rows > _MAX_ROWS:
                chunks.append([])
            chunks[-1].append(actor)
        for version, chunks in batches.items():
            for actors in chunks:
                _answer(version.runtime, actors)

    def _forget(self, actor: _Actor) -> None:
        self._selector.unregister(actor.socket)
        actor.socket.close()
        if actor.policy is not None and actor.version is not None:
            actor.policy.release(actor.version)


def _answer(runtime: PolicyRuntime, actors: list[_Actor]) -> None:
    """Choose the actions of actors with the same weights, and answer them. What fails for one fails for it alone."""
    answer = {}
    try:
        _choose(runtime, actors)
    except (PolicyError, ValueError, TypeError, LookupError) as error:
        if len(actors) > 1:
            for actor in actors:
                _answer(runtime, [actor])
            return
        answer = _refusal(error)
    for actor in actors:
        actor.answer(answer)


def _refusal(error: Exception) -> dict[str, str]:
    """Return the answer after an error. As JSON, a character has up to 12 bytes, and a packet PACKET_BYTES."""
    return {"error": message_line(error)[: PACKET_BYTES // 16]}


def _choose(runtime: PolicyRuntime, actors: list[_Actor]) -> None:
    """Choose the actions of actors with the same weights, in one call."""
    parts = [actor.region.named("in/", actor.rows) for actor in actors if actor.region is not None]
    inputs = parts[0]
    if len(parts) > 1:
        inputs = {name: np.concatenate([part[name] for part in parts]) for name in inputs}
    observations, masks = _of("observations/", inputs), _of("masks/", inputs)
    noise = Noise(inputs["uniform"], inputs["normal"])
    choice = runtime.act(observations, inputs["state"], noise, masks, inputs["epsilon"])
    chosen = {f"actions/{name}": values for name, values in choice.actions.items()}
    chosen |= {"log_prob": choice.log_probs, "next_state": choice.state}
    first = 0
    for actor in actors:
        assert actor.region is not None
        for name, array in actor.region.named("out/", actor.rows).items():
            array[...] = chosen[name][first : first + actor.rows]
        first += actor.rows


def _of(beginning: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name.removeprefix(beginning): each for name, each in arrays.items() if name.startswith(beginning)}


def main() -> int:
    """Run the process and return its exit status."""
    options = argparse.ArgumentParser(prog="python -m daedalus.launch.inference_process", description=__doc__)
    options.add_argument("path", help="Unix socket to serve actors at")
    options.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    options.add_argument("--exit-with-parent", action="store_true")
    options.add_argument("--log-level", default="info")
    options.add_argument("--log-json", action="store_true")
    parsed = options.parse_args()
    configure_logging(parsed.log_level, as_json=parsed.log_json, process="inference")
    stop = stop_on_signals(exit_if_stuck=True, on_leave=lambda _: None)  # it ends after its actors
    if parsed.exit_with_parent:
        exit_with_parent(stop)
    raise_descriptor_limit()  # an actor has three
    threads = max(available_processors() // 2, 1)  # actors that wait leave their cores
    Inference(parsed.device, threads, stop).serve(parsed.path)
    return 0


def run_process() -> NoReturn:
    """Run the command of this process, and end it."""
    exit_on_thread_exceptions()
    sys.exit(exit_status(main))


if __name__ == "__main__":
    run_process()
