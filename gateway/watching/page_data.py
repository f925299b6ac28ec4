"""The newest observation on the event loop, and the viewers that wait for changes."""

import asyncio
from collections.abc import AsyncGenerator, Callable
from typing import Protocol

from daedalus.gateway.places import Places
from daedalus.gateway.watching.observation import Observation
from daedalus.gateway.watching.source import OtherRun
from daedalus.protocol.messages import Order

MAX_VIEWERS = 32
_OPERATORS = 4  # further pages, for operators

GiveOrder = Callable[[Order], tuple[bool, str]]  # waits for the learner, as RunSource.order


class Camera(Protocol):
    """What shows episodes to viewers."""

    def frames(self) -> AsyncGenerator[bytes, None]:
        """Yield frames as soon as there are any, and the newest only, until the caller stops."""
        ...


def _nobody(order: Order) -> tuple[bool, str]:
    return False, "the learner was not reached yet: try again later"


class PageData:
    """What all viewers see. For the event loop."""

    def __init__(
        self,
        other_runs: Callable[[], list[OtherRun]] = lambda: [],
        camera: Camera | None = None,
        *,
        takes_clients: bool = True,
    ) -> None:
        """Construct the data.

        Args:
          other_runs: reads the runs to compare with; it may take long.
          camera: shows episodes; None: there is no camera.
          takes_clients: whether the gateway has clients too; otherwise it serves its page only.
        """
        self.other_runs, self.camera, self.takes_clients = other_runs, camera, takes_clients
        self.seen = Observation()
        self.give_order: GiveOrder = _nobody
        self.on_watch: Callable[[bool], None] = lambda watched: None  # receives whether anybody watches
        self.places = Places(MAX_VIEWERS, "pages", reserved=_OPERATORS)
        self._changed = asyncio.Event()

    @property
    def is_watched(self) -> bool:
        """Whether anybody watches."""
        return self.places.taken > 0

    def show(self, seen: Observation) -> None:
        """Show an observation to all viewers."""
        self.seen = seen
        self._changed.set()
        self._changed = asyncio.Event()

    @property
    def news(self) -> asyncio.Event:
        """An event that the next observation sets."""
        return self._changed
