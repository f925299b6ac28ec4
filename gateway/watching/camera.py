"""The camera: a process of its own that plays episodes while somebody watches, and stops when nobody does."""

import asyncio
from collections.abc import AsyncGenerator, Sequence
from functools import partial

from daedalus.gateway.learner_link import NewestPolicy
from daedalus.gateway.watching.playing_process import (
    LONGEST_END_SECONDS,
    PolicySource,
    note,
    run_process,
    send,
    send_policy,
)
from daedalus.protocol.codec import encode

_POLL_SECONDS = 0.5  # for a policy, and for a newer one
_AGAIN_SECONDS = 5.0  # after the process failed


class CameraProcess:
    """A Camera (page_data.py). For the event loop."""

    def __init__(self, command: Sequence[str], policies: PolicySource) -> None:
        """`command` starts the process; the program is the first word."""
        self._command, self._policies = command, policies
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
            await asyncio.wait(list(self._tasks), timeout=LONGEST_END_SECONDS)

    def _show(self, frame: bytes) -> None:
        self._frame, self._number = frame, self._number + 1
        self._changed.set()
        self._changed = asyncio.Event()

    async def _run(self) -> None:
        """Run one process after the other, while somebody watches; each to its end, or until another run begins."""
        while True:
            policy = self._policies.newest()
            if policy is None:
                self._show(note("There is no policy yet: the camera waits for the learner."))
                await asyncio.sleep(_POLL_SECONDS)
                continue
            try:
                await run_process(self._command, partial(self._feed, policy), self._show)
            except OSError as error:
                self._show(note(f"The camera cannot be started: {error.strerror}"))
            await asyncio.sleep(_AGAIN_SECONDS)

    async def _feed(self, policy: NewestPolicy, writer: asyncio.StreamWriter) -> None:
        """Send the policy, and every newer one of the same session."""
        await send_policy(writer, policy)
        version = policy.snapshot.policy_version
        while True:
            await asyncio.sleep(_POLL_SECONDS)
            self._policies.fetch()
            newest = self._policies.newest()
            if newest is None or newest.session is not policy.session:
                return
            if newest.snapshot.policy_version > version:
                version = newest.snapshot.policy_version
                await send(writer, encode(newest.snapshot))
