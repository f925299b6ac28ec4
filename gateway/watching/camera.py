"""The camera: a process of its own that plays episodes while somebody watches, and stops when nobody does.

Messages in both directions have four bytes with their length before them. The process receives the Welcome, the Program
and every newer Snapshot, encoded as on the wire; it sends frames as the page takes them: four bytes with the length of
a map in JSON, that map, and a JPEG.
"""

import asyncio
import contextlib
import json
import logging
import math
import os
import struct
from collections.abc import AsyncGenerator, Callable, Sequence

import numpy as np

from daedalus.gateway.learner_link import NewestPolicy
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Program

_logger = logging.getLogger(__name__)

LENGTH = struct.Struct("<I")
MAX_FRAME_BYTES = 8 << 20
_POLL_SECONDS = 0.5  # for a policy, and for a newer one
_AGAIN_SECONDS = 5.0  # after the process failed
_END_SECONDS = 2.0  # after SIGTERM
_KILLED_SECONDS = 1.0  # after SIGKILL
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def note(text: str) -> bytes:
    """Return a frame without a picture: why there is none."""
    return frame({"error": text}, b"")


def frame(facts: dict[str, object], picture: bytes) -> bytes:
    """Return a frame for the page, with null for numbers that JSON does not have."""
    described = json.dumps(_finite(facts), separators=(",", ":"), allow_nan=False).encode()
    return LENGTH.pack(len(described)) + described + picture


def _finite(value: object) -> object:
    match value:
        case dict():
            return {key: _finite(part) for key, part in value.items()}
        case list() | tuple():
            return [_finite(part) for part in value]
        case float() if not math.isfinite(value):
            return None
    return value


class CameraProcess:
    """A Camera (page_data.py). For the event loop."""

    def __init__(self, command: Sequence[str]) -> None:
        """`command` starts the process; the program is the first word."""
        self._command = command
        self.newest_policy: Callable[[], NewestPolicy | None] = lambda: None
        self.fetch_policy: Callable[[], None] = lambda: None  # asks for a newer one
        self._frame, self._number = b"", 0
        self._changed = asyncio.Event()
        self._viewers = 0
        self._task: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()  # also those that are ending

    async def frames(self) -> AsyncGenerator[bytes, None]:
        """See Camera."""
        self._viewers += 1
        if self._task is None:
            self._task = asyncio.create_task(self._run())
            self._tasks.add(self._task)
            self._task.add_done_callback(self._tasks.discard)
        seen = self._number if self._viewers == 1 else self._number - 1  # one that is long over is not shown
        try:
            while True:
                changed = self._changed
                if self._number > seen and self._frame:
                    seen = self._number
                    yield self._frame
                else:
                    await changed.wait()
        finally:
            self._viewers -= 1
            if not self._viewers:
                self._stop()

    def _stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def close(self) -> None:
        """End the process. At most about 4 s."""
        self._stop()
        if self._tasks:
            await asyncio.wait(list(self._tasks), timeout=_END_SECONDS + _KILLED_SECONDS + 1.0)

    def _show(self, frame: bytes) -> None:
        self._frame, self._number = frame, self._number + 1
        self._changed.set()
        self._changed = asyncio.Event()

    async def _run(self) -> None:
        """Run one process after the other, while somebody watches."""
        while True:
            policy = self.newest_policy()
            if policy is None:
                self._show(note("There is no policy yet: the camera waits for the learner."))
                await asyncio.sleep(_POLL_SECONDS)
                continue
            try:
                await self._film(policy)
            except OSError as error:
                self._show(note(f"The camera cannot be started: {error.strerror}"))
            await asyncio.sleep(_AGAIN_SECONDS)

    async def _film(self, policy: NewestPolicy) -> None:
        """Run a process to its end, or until another run begins."""
        process = await asyncio.create_subprocess_exec(
            *self._command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
        )
        assert process.stdin is not None
        assert process.stdout is not None
        working = [
            asyncio.ensure_future(self._feed(process.stdin, policy)),
            asyncio.ensure_future(self._take(process.stdout)),
        ]
        try:
            await asyncio.wait(working, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in working:
                task.cancel()
            await _end(process, working)

    async def _feed(self, writer: asyncio.StreamWriter, policy: NewestPolicy) -> None:
        """Send the policy, and every newer one of the same session."""
        model = Program(hash=policy.snapshot.program, model=np.frombuffer(policy.program, np.uint8))
        with contextlib.suppress(OSError):  # the process has ended: its frames say why
            for message in (policy.session, model, policy.snapshot):
                await _send(writer, encode(message))
            version = policy.snapshot.policy_version
            while True:
                await asyncio.sleep(_POLL_SECONDS)
                self.fetch_policy()
                newest = self.newest_policy()
                if newest is None or newest.session is not policy.session:
                    return
                if newest.snapshot.policy_version > version:
                    version = newest.snapshot.policy_version
                    await _send(writer, encode(newest.snapshot))

    async def _take(self, reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError):  # the process has ended
            while True:
                (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
                if length > MAX_FRAME_BYTES:
                    _logger.warning("the camera sent a frame of %d bytes: it is stopped", length)
                    return
                self._show(await reader.readexactly(length))


async def _send(writer: asyncio.StreamWriter, message: bytes) -> None:
    writer.write(LENGTH.pack(len(message)) + message)
    await writer.drain()


async def _end(process: asyncio.subprocess.Process, working: Sequence[asyncio.Future[None]]) -> None:
    """End a process, also if this task is cancelled once more."""
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(_drain(process, working), _END_SECONDS)
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
        # Once more, because the task that read its output may have been cancelled with this one.
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(_drain(process, working), _KILLED_SECONDS)


async def _drain(process: asyncio.subprocess.Process, working: Sequence[asyncio.Future[None]]) -> None:
    """Wait for the end of a process, and read what it has written: with unread output its pipes stay open for ever."""
    await asyncio.wait(working)
    await process.communicate()
