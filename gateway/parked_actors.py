"""The actors of clients that disconnected a moment ago, and may return to their rollouts. State."""

import time
from collections.abc import Iterator

from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_spaces import ClientSpaces

_SECONDS = 60.0  # for which a client may return


class ParkedActors:
    """Up to a number of actors; the one that has been absent longest goes first."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._actors: dict[str, tuple[float, ClientActor]] = {}  # by name, the oldest first

    def __iter__(self) -> Iterator[ClientActor]:
        return (actor for _, actor in self._actors.values())

    def park(self, actor: ClientActor) -> None:
        """Keep an actor whose client has disconnected."""
        self._actors[actor.name] = time.monotonic(), actor
        if len(self._actors) > self._most:
            self.release_oldest()

    def take(self, name: str, spaces: ClientSpaces) -> ClientActor | None:
        """Return the actor of a client that returns with the same spaces."""
        _, actor = self._actors.pop(name, (0.0, None))
        if actor is not None and actor.spaces.stated != spaces.stated:
            actor.release()
            return None
        return actor

    def release_oldest(self) -> None:
        """Release the actor that has been absent longest, if there is one."""
        if self._actors:
            _, actor = self._actors.pop(next(iter(self._actors)))
            actor.release()

    def release_late(self, now: float) -> None:
        """Release those that did not return in time."""
        while self._actors and now > next(iter(self._actors.values()))[0] + _SECONDS:
            self.release_oldest()

    def clear(self) -> None:
        """Release all."""
        while self._actors:
            self.release_oldest()
