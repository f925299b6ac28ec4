"""A network in virtual time, whose messages are lost, duplicated, delayed and reordered.

Every process has one link to one router. A link is up, cut (nothing passes; presence is lost after the lease), or dead:
cut until the process opens another session.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daedalus.transport import memory

from .kernel import Kernel

if TYPE_CHECKING:
    from .link import Link
    from .traffic import LinkRequest

matches = functools.lru_cache(maxsize=4096)(memory.matches)


@dataclass(frozen=True, slots=True, kw_only=True)
class Weather:
    """How messages travel. Probabilities are of one message."""

    delay: float = 0.005  # seconds: the longest usual delay
    slow: float = 0.0  # probability of a delay of up to `slow_seconds`
    slow_seconds: float = 0.0
    lost: float = 0.0  # probability that a query, an answer or a pushed value is lost
    noticed: float = 0.0  # probability that the sender of a lost query is told soon, before the timeout
    duplicated: float = 0.0  # probability that a query arrives twice
    refused: float = 0.0  # probability that an operation on a cut link raises TransportError
    lease: float = 1.0  # seconds after which a process whose link is cut is absent for the others


CALM = Weather()


class Network:
    """The router, and the links of all processes to it."""

    def __init__(self, kernel: Kernel, weather: Weather) -> None:
        self.kernel, self.weather = kernel, weather
        self.links: list[Link] = []
        self.on_reply: Callable[[LinkRequest, bytes], None] = lambda request, payload: None
        self._cut = False

    @property
    def cut(self) -> bool:
        """Whether the router is out of reach for everybody."""
        return self._cut

    @cut.setter
    def cut(self, cut: bool) -> None:
        self._cut = cut
        for link in list(self.links):
            link.reachability_changed()

    def delay(self) -> float:
        """Return how long one message takes."""
        random, weather = self.kernel.random.random, self.weather
        seconds = 0.0002 + weather.delay * random()
        return seconds + weather.slow_seconds * random() if weather.slow and random() < weather.slow else seconds

    def chance(self, probability: float) -> bool:
        """Return whether something with a probability happens."""
        return probability > 0.0 and self.kernel.random.random() < probability

    def servers(self, key: str) -> list[tuple["Link", str]]:
        """Return the links that serve a key, with the key under which they do."""
        return [
            (link, served)
            for link in self.links
            if not link.expired
            for served in link.handlers
            if matches(served, key)
        ]

    def presence_changed(self, key: str) -> None:
        """Tell everybody who watches a key, in a while."""
        for link in self.links:
            for watch in link.watches:
                if matches(watch.pattern, key):
                    watch.look_later(key)

    def is_present(self, key: str, watcher: "Link") -> bool:
        """Return whether a link sees a key."""
        return any(
            key in link.tokens and (link is watcher or not (link.expired or watcher.expired)) for link in self.links
        )
