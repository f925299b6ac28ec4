"""PolicyRuntime whose policy runs in another process of this machine, for several actors at a time. Linux only.

The other process is launch/inference_process.py. Each actor has a Unix socket of packets, and shared memory in which
both find the weights, the inputs and the outputs at the same places (`Region`). A packet says what to do; no array
passes through the socket. The actor draws the noise, so that its actions depend on its own seed alone.
"""

import json
import logging
import math
import mmap
import os
import socket
import threading
import time
import weakref
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from daedalus.policy.acting.noise import Noise, NoiseSize
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.program_session import CALL_SECONDS, STOP_SECONDS
from daedalus.policy.acting.runtime import Choice
from daedalus.policy.user_code import message_line
from daedalus.protocol.spaces import DiscreteSpace, Spaces

PACKET_BYTES = 4096  # at most, of a packet
_MAX_REGION_BYTES = 8 << 30
_ALIGNMENT = 64
_DTYPES = {"bool", "uint8", "uint16", "int64", "float32"}
_POLL_SECONDS = 0.2
_RETRY_SECONDS = 0.1

_logger = logging.getLogger(__name__)


class Shape(NamedTuple):
    """What one array of a region is."""

    name: str
    dtype: str
    shape: tuple[int, ...]


class Region:
    """Shared memory of an actor and the process of its policy: named arrays, described at its beginning.

    Attributes:
      arrays: by name. The names of weights begin with `weights/`, of inputs with `in/`, of outputs with `out/`.
      descriptor: of the memory's file, which another process may receive. In the process that received it, its caller
        closes it.
    """

    def __init__(self, descriptor: int, shapes: list[Shape], begin: int) -> None:
        self.descriptor = descriptor
        self.arrays: dict[str, np.ndarray] = {}
        memory = mmap.mmap(descriptor, 0)  # until nobody refers to the arrays any more
        for each in shapes:
            size = np.dtype(each.dtype).itemsize * math.prod(each.shape)
            flat = np.frombuffer(memory, np.uint8, size, begin)
            self.arrays[each.name] = flat.view(each.dtype).reshape(each.shape)
            begin += -(-size // _ALIGNMENT) * _ALIGNMENT

    @classmethod
    def create(cls, shapes: list[Shape]) -> "Region":
        """Return new shared memory, filled with zeros."""
        described = json.dumps(shapes).encode()
        begin, size = _extent(shapes, len(described))
        descriptor = os.memfd_create("daedalus-inference")
        os.truncate(descriptor, size)
        os.pwrite(descriptor, len(described).to_bytes(8, "little") + described, 0)
        region = cls(descriptor, shapes, begin)
        weakref.finalize(region, os.close, descriptor)
        return region

    @classmethod
    def open(cls, descriptor: int) -> "Region":
        """Return the shared memory of another process. Raises ValueError if it is not as its beginning says."""
        size = os.fstat(descriptor).st_size
        length = int.from_bytes(os.pread(descriptor, 8, 0), "little")
        if not 0 < length <= size <= _MAX_REGION_BYTES:
            raise ValueError(f"shared memory of {size} bytes has a description of {length}")
        shapes = [
            Shape(name, dtype, tuple(shape)) for name, dtype, shape in json.loads(os.pread(descriptor, length, 8))
        ]
        if not all(each.dtype in _DTYPES and all(side >= 0 for side in each.shape) for each in shapes):
            raise ValueError("shared memory has an array of an unknown dtype, or of a negative size")
        begin, expected = _extent(shapes, length)
        if size != expected:
            raise ValueError(f"shared memory has {size} bytes, its description says {expected}")
        return cls(descriptor, shapes, begin)

    def named(self, beginning: str, rows: int | None = None) -> dict[str, np.ndarray]:
        """Return the arrays whose names have this beginning, without it: all of them, or their first rows."""
        return {
            name.removeprefix(beginning): array[:rows]
            for name, array in self.arrays.items()
            if name.startswith(beginning)
        }


def _extent(shapes: list[Shape], described: int) -> tuple[int, int]:
    """Return where the arrays begin, and the size of the whole region."""
    begin = -(-(8 + described) // _ALIGNMENT) * _ALIGNMENT
    sizes = [np.dtype(each.dtype).itemsize * math.prod(each.shape) for each in shapes]
    return begin, begin + sum(-(-size // _ALIGNMENT) * _ALIGNMENT for size in sizes)


class SharedRuntime:
    """Lets the inference process of this machine run a policy. If that process dies, it waits for the next one."""

    def __init__(
        self, path: str, setup: Mapping[str, Any], program: bytes, spaces: Spaces, stop: threading.Event
    ) -> None:
        """Connect to the process.

        Args:
          path: of the socket of the process.
          setup: without a program, what torch makes the network from: `learning` and `spaces`, as JSON has them.
          program: the program, or empty.
          spaces: of the environments.
          stop: ends a call that is in progress; it then raises PolicyError.

        Raises PolicyError if no process answers, or it cannot make the policy.
        """
        self._socket: socket.socket | None = None
        self._path, self._spaces, self._stop = path, spaces, stop
        made = json.dumps(setup).encode()
        self._setup = Region.create([Shape("setup", "uint8", (len(made),)), Shape("program", "uint8", (len(program),))])
        self._setup.arrays["setup"][:] = np.frombuffer(made, np.uint8)
        self._setup.arrays["program"][:] = np.frombuffer(program, np.uint8)
        self._region: Region | None = None
        self._stopped_at = math.inf  # when `stop` was found set
        self._sizes = self._connect(time.monotonic() + CALL_SECONDS)

    @property
    def state_size(self) -> int:
        """See PolicyRuntime."""
        return self._sizes["state"]

    @property
    def noise_size(self) -> NoiseSize:
        """See PolicyRuntime."""
        return NoiseSize(self._sizes["uniform"], self._sizes["normal"])

    @property
    def explores(self) -> bool:
        """See PolicyRuntime."""
        return self._sizes["explores"]

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See PolicyRuntime. The process keeps equal weights of several actors once."""
        if self._region is None:
            self._allocate(weights, rows=1)
            return
        held = self._region.named("weights/")
        if _shapes_of(held) != _shapes_of(weights):
            raise PolicyError("the snapshot has other weights, or weights of other shapes, than the one before it")
        for name, values in weights.items():
            held[name][...] = values
        self._ask("load")

    def _allocate(self, weights: dict[str, np.ndarray], rows: int) -> None:
        """Load weights, with memory for so many rows."""
        region = Region.create(self._shapes(weights, rows))
        for name, array in region.named("weights/").items():
            array[...] = weights[name]
        self._region = region
        self._ask("region")
        self._ask("load")

    def act(
        self,
        observations: dict[str, np.ndarray],
        state: np.ndarray,
        noise: Noise,
        masks: dict[str, np.ndarray],
        epsilon: np.ndarray | None = None,
    ) -> Choice:
        """See PolicyRuntime. Raises PolicyError if the process does not answer in time, or its policy fails."""
        assert self._region is not None, "load weights before the first action"
        rows = len(state)
        if rows > len(self._region.arrays["out/log_prob"]):
            self._allocate(self._region.named("weights/"), rows)
        given = {
            **{f"observations/{name}": values for name, values in observations.items()},
            **{f"masks/{name}": mask for name, mask in masks.items()},
            "state": state,
            "uniform": noise.uniform,
            "normal": noise.normal,
            "epsilon": np.zeros((rows, 1), np.float32) if epsilon is None else epsilon,
        }
        for name, array in self._region.named("in/", rows).items():
            array[...] = given[name]
        self._ask(f"act {rows}")
        chosen = {name: array.copy() for name, array in self._region.named("out/", rows).items()}
        log_probs, next_state = chosen.pop("log_prob"), chosen.pop("next_state")
        return Choice({name.removeprefix("actions/"): values for name, values in chosen.items()}, log_probs, next_state)

    def _shapes(self, weights: dict[str, np.ndarray], rows: int) -> list[Shape]:
        sizes = self._sizes
        shapes = [Shape(f"weights/{name}", dtype, shape) for name, (shape, dtype) in _shapes_of(weights).items()]
        for name, space in self._spaces.observations.items():
            shapes.append(Shape(f"in/observations/{name}", space.dtype, (rows, *space.stacked_shape)))
        for name, choices in self._spaces.masks.items():
            shapes.append(Shape(f"in/masks/{name}", "bool", (rows, choices)))
        for name, size in (*((each, sizes[each]) for each in ("state", "uniform", "normal")), ("epsilon", 1)):
            shapes.append(Shape(f"in/{name}", "float32", (rows, size)))
        for name, space in self._spaces.actions.items():
            dtype = "int64" if isinstance(space, DiscreteSpace) else "float32"  # as OnnxRuntime has them
            shapes.append(Shape(f"out/actions/{name}", dtype, (rows, space.size)))
        shapes.append(Shape("out/log_prob", "float32", (rows,)))
        shapes.append(Shape("out/next_state", "float32", (rows, sizes["state"])))
        return shapes

    def _ask(self, what: str) -> None:
        """Send a packet and wait until it is done. A process that has died is waited for, and asked again."""
        deadline = time.monotonic() + CALL_SECONDS
        while True:
            try:
                if self._socket is None:
                    self._connect(deadline)
                self._exchange(what, self._region, deadline)
                return
            except OSError as error:
                self._disconnect()
                _logger.warning(
                    "the inference process of this machine has ended (%s): waiting for it to start again",
                    message_line(error),
                )

    def _connect(self, deadline: float) -> dict[str, Any]:
        """Connect, and let the process make the policy and load the weights that were loaded before."""
        while True:
            self._check_time(deadline, "no inference process answers")
            try:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                self._socket.settimeout(_POLL_SECONDS)
                self._socket.connect(self._path)
                sizes = self._exchange("begin", self._setup, deadline)
                if self._region is not None:
                    self._exchange("region", self._region, deadline)
                    self._exchange("load", self._region, deadline)
            except OSError:  # it starts
                self._disconnect()
                time.sleep(_RETRY_SECONDS)
            else:
                return sizes

    def _exchange(self, what: str, region: Region | None, deadline: float) -> dict[str, Any]:
        """Send a packet, with the region if the process is to open it, and return the answer."""
        assert self._socket is not None
        sent = [region.descriptor] if region is not None and what in ("begin", "region") else []
        socket.send_fds(self._socket, [what.encode()], sent)
        while True:
            try:
                packet = self._socket.recv(PACKET_BYTES)
            except TimeoutError:
                self._check_time(deadline, "the inference process does not answer")
                continue
            if not packet:
                raise ConnectionResetError("it has closed the connection")
            answer = json.loads(packet)
            if "error" in answer:
                raise PolicyError(f"the inference process: {answer['error']}")
            return answer

    def _check_time(self, deadline: float, problem: str) -> None:
        now = time.monotonic()
        if self._stop.is_set():
            self._stopped_at = min(self._stopped_at, now)
        if now > min(deadline, self._stopped_at + STOP_SECONDS):
            self._disconnect()
            raise PolicyError(f"{problem} at {self._path}")

    def __del__(self) -> None:
        """Let the process forget this actor."""
        self._disconnect()

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None


def _shapes_of(arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[tuple[int, ...], str]]:
    return {name: (array.shape, str(array.dtype)) for name, array in arrays.items()}
