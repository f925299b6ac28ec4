"""Processes of a gateway that play with the policy for the page: the camera, and matches against a person.

Messages in both directions have four bytes with their length before them. A process receives the Welcome, the Program
and newer Snapshots, encoded as on the wire, and a match also orders as JSON; it sends frames: four bytes with the
length of a map in JSON, that map, and a JPEG or nothing.
"""

import asyncio
import contextlib
import json
import logging
import math
import os
import struct
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from daedalus.gateway.learner_link import NewestPolicy
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Program

_logger = logging.getLogger(__name__)

LENGTH = struct.Struct("<I")
MAX_FRAME_BYTES = 8 << 20
_END_SECONDS = 2.0  # after SIGTERM
_KILLED_SECONDS = 1.0  # after SIGKILL
LONGEST_END_SECONDS = _END_SECONDS + _KILLED_SECONDS + 1.0
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(slots=True)
class PolicySource:
    """Where processes get the policy. The gateway sets both functions once it has reached the network."""

    newest: Callable[[], NewestPolicy | None] = lambda: None
    fetch: Callable[[], None] = lambda: None  # asks for a newer one


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


Feed = Callable[[asyncio.StreamWriter], Coroutine[Any, Any, None]]


async def run_process(command: Sequence[str], feed: Feed, show: Callable[[bytes], None]) -> None:
    """Run a process until it ends, or until `feed` returns. Raises OSError.

    Args:
      command: starts the process; the program is the first word.
      feed: writes to the process.
      show: receives each frame.
    """
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        env={**os.environ, **_ONE_THREAD},
    )
    assert process.stdin is not None
    assert process.stdout is not None
    working = [asyncio.ensure_future(_fed(feed, process.stdin)), asyncio.ensure_future(_take(process.stdout, show))]
    try:
        await asyncio.wait(working, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in working:
            task.cancel()
        await _end(process, working)


async def _fed(feed: Feed, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):  # the process has ended: its frames say why
        await feed(writer)


async def _take(reader: asyncio.StreamReader, show: Callable[[bytes], None]) -> None:
    with contextlib.suppress(asyncio.IncompleteReadError):  # the process has ended
        while True:
            (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
            if length > MAX_FRAME_BYTES:
                _logger.warning("a process sent a frame of %d bytes: it is stopped", length)
                return
            show(await reader.readexactly(length))


async def send_policy(writer: asyncio.StreamWriter, policy: NewestPolicy) -> None:
    """Send the first messages of a process."""
    model = Program(hash=policy.snapshot.program, model=np.frombuffer(policy.program, np.uint8))
    for message in (policy.session, model, policy.snapshot):
        await send(writer, encode(message))


async def send(writer: asyncio.StreamWriter, message: bytes) -> None:
    """Send one message."""
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
