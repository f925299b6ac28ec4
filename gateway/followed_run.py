"""The run that a gateway follows, and how its learner changes. For the gateway's event loop."""

import asyncio
from collections.abc import Callable

from daedalus.protocol.messages import Welcome


class FollowedRun:
    """The learner of the run, and how the last run ended."""

    def __init__(self) -> None:
        self.session: Welcome | None = None  # of the learner that is followed
        self.name = ""  # of the run that is or was followed
        self.last_end = ""  # how the last run ended, until another begins
        self.on_change: Callable[[], None] = lambda: None  # called when a learner was found, or a run has ended
        self._changed = asyncio.Event()

    def begin(self, session: Welcome) -> None:
        """Follow a learner."""
        self.session, self.name, self.last_end = session, session.run, ""
        self.announce()
        self.on_change()

    def end(self, reason: str) -> None:
        """Note that the run has ended."""
        self.session, self.last_end = None, reason
        self.on_change()

    def announce(self) -> None:
        """Wake those that wait for a change."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def change(self) -> None:
        """Wait for another learner, or for a policy."""
        await self._changed.wait()
