"""What passes a link: queries, their answers, pushed values, and news of who is present."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from daedalus.transport.interface import OnAnswer

from .kernel import Killed
from .process import Channel

if TYPE_CHECKING:
    from .link import Link


class Query:
    """One query that its sender waits for."""

    def __init__(self, link: "Link", on_answer: OnAnswer) -> None:
        self.link, self.session = link, link.session
        self._on_answer: OnAnswer | None = on_answer
        self._channel = Channel(link.process, "answer")

    def finish(self, answer: bytes | None) -> None:
        on_answer, self._on_answer = self._on_answer, None
        if on_answer is not None:
            self.link.queries.pop(self, None)
            self._channel.deliver(on_answer, answer)


class LinkRequest:
    """A query as its server receives it."""

    def __init__(self, server: "Link", query: Query, key: str, payload: bytes) -> None:
        self.server, self.query, self.key, self._payload = server, query, key, payload
        self.size = len(payload)
        self.finds_others = False  # whether a router far away sends it to whoever serves the key by then
        self._answered = False

    @property
    def payload(self) -> bytes:
        return self._payload

    def reply(self, payload: bytes) -> None:
        server = self.server
        if server.network.kernel.current.killed:
            raise Killed
        if self._answered:
            return
        self._answered = True
        network, client = server.network, self.query.link
        network.on_reply(self, payload)
        if server.passes() and not network.chance(network.weather.lost):
            server.send(self._arrive, payload)
        elif network.chance(network.weather.noticed):
            network.kernel.after(network.kernel.random.random(), self.query.finish, None)
        else:
            network.kernel.log("answer lost", server.process.name, client.process.name, self.key)

    def _arrive(self, payload: bytes) -> None:
        client = self.query.link
        if client.passes() and client.session == self.query.session:
            self.query.finish(payload)


class LinkInbox:
    """The newest unread value of a subscription."""

    def __init__(self, link: "Link", key: str, on_news: Callable[[], None]) -> None:
        self.key, self._link, self._on_news = key, link, on_news
        self._newest: bytes | None = None
        self._channel = Channel(link.process, "value")

    def arrive(self, payload: bytes, session: int) -> None:
        if self.key and self._link.passes() and self._link.session == session:
            self._channel.deliver(self._put, payload)

    def _put(self, payload: bytes) -> None:
        self._newest = payload
        self._on_news()

    def take(self) -> bytes | None:
        newest, self._newest = self._newest, None
        return newest

    def close(self) -> None:
        self.key = ""


class Watch:
    """What one link was told about the presence of keys."""

    def __init__(self, link: "Link", pattern: str, on_change: Callable[[str, bool], None]) -> None:
        self.pattern, self.told = pattern, dict[str, bool]()
        self._link, self._on_change = link, on_change
        self._channel = Channel(link.process, "presence")

    def look_later(self, key: str) -> None:
        network = self._link.network
        network.kernel.after(network.delay(), self.look, key)

    def look(self, key: str) -> None:
        self._tell(key, self._link.network.is_present(key, self._link))

    def forget(self, key: str) -> None:
        """Tell that a key is absent, and look again in a while: the network was wrong."""
        self._tell(key, False)
        self.look_later(key)

    def _tell(self, key: str, present: bool) -> None:
        if self._link.alive and not self._link.dead and self.told.get(key, False) != present:
            self.told[key] = present
            self._link.network.kernel.log("presence", self._link.process.name, key, present)
            self._channel.deliver(self._on_change, key, present)


class LinkPresence:
    """A declared presence. No simulated process withdraws one before it closes its link."""

    def __init__(self, link: "Link", key: str) -> None:
        self._link, self._key = link, key

    def close(self) -> None:
        if self._link.tokens.pop(self._key, self) is None:
            self._link.network.presence_changed(self._key)
