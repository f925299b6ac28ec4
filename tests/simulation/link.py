"""The Transport of one simulated process."""

from collections.abc import Callable
from typing import Any

from daedalus.protocol import keys
from daedalus.transport.interface import Declaration, Inbox, OnAnswer, Request, TransportError

from .network import Network, matches
from .process import Channel, Process
from .traffic import LinkInbox, LinkPresence, LinkRequest, Query, Watch


class Link:
    """The Transport of one process."""

    def __init__(self, network: Network, process: Process, *, is_router: bool = False) -> None:
        """Open the link. A process that is the router never reopens it."""
        self.network, self.process, self._is_router = network, process, is_router
        self.alive = True  # until it is closed
        self.cut = self.dead = False
        self.expired = False  # whether the others do not see this process any more
        self.session = 0
        self.handlers: dict[str, tuple[Callable[[Request], None], Channel]] = {}
        self.tokens: dict[str, None] = {}
        self.inboxes: list[LinkInbox] = []
        self.watches: list[Watch] = []
        self.queries: dict[Query, None] = {}
        self._sent_until = 0.0  # when the last message will have arrived
        network.links.append(self)

    def passes(self) -> bool:
        """Return whether messages pass this link now."""
        return self.alive and not (self.cut or self.dead or self.network.cut)

    @property
    def _keeps_alive(self) -> bool:
        return self.passes() and not self.process.frozen

    @property
    def seconds_to_send(self) -> float:
        """How long the messages under way need."""
        return max(self._sent_until - self.network.kernel.now, 0.0)

    def send(self, arrive: Callable[..., None], *arguments: Any) -> None:
        """Let a message of this process arrive in a while."""
        seconds = self.network.delay() + self.network.delay()
        self._sent_until = max(self._sent_until, self.network.kernel.now + seconds)
        self.network.kernel.after(seconds, arrive, *arguments)

    def reachability_changed(self) -> None:
        """Lose presence after the lease, or get it back."""
        if self._keeps_alive:
            if self.expired:
                self.expired = False
                self._presence_changed()
        else:
            self.network.kernel.after(self.network.weather.lease, self._expire, self.session)

    def process_killed(self) -> None:
        """Close the link without a word: the others notice after the lease."""
        self.alive = False
        self.network.kernel.after(self.network.weather.lease * self.network.kernel.random.random(), self._remove)

    def die(self) -> None:
        """Let nothing pass until the session is opened again; the process itself is not told."""
        self.dead = True
        self.reachability_changed()

    def flicker(self) -> None:
        """Let all others see this process go and come."""
        for key in self.tokens:
            for link in self.network.links:
                for watch in link.watches:
                    if link is not self and matches(watch.pattern, key):
                        watch.forget(key)

    def _expire(self, session: int) -> None:
        if not self._keeps_alive and self.session == session and not self.expired:
            self.expired = True
            self._presence_changed()

    def _presence_changed(self) -> None:
        for key in self.tokens:
            self.network.presence_changed(key)
        for watch in self.watches:
            for key in {key: None for link in self.network.links for key in link.tokens}:
                if matches(watch.pattern, key):
                    watch.look_later(key)

    def _remove(self) -> None:
        network = self.network
        if self not in network.links:
            return
        network.links.remove(self)
        for key in self.tokens:
            network.presence_changed(key)

    # ---------------------------------------------------------------------------------------------- Transport

    def _enter(self, operation: str) -> None:
        self.network.kernel.perhaps_preempt()
        if not self.alive:
            raise TransportError("the session is closed")
        if not self.passes() and self.network.chance(self.network.weather.refused):
            raise TransportError(f"cannot {operation}: the session is being replaced")

    @property
    def local_address(self) -> str:
        return "simulation"

    def serve(self, key: str, handler: Callable[[Request], None]) -> None:
        self.handlers[key] = handler, Channel(self.process, "query")

    def query(self, key: str, payload: bytes = b"", *, timeout: float) -> list[bytes]:
        kernel, task = self.network.kernel, self.network.kernel.current
        came: list[list[bytes]] = []

        def on_answers(answers: list[bytes]) -> None:
            came.append(answers)
            kernel.wake(task)

        self.ask(key, payload, timeout, on_answers)
        while not came:
            kernel.park(None)
        return came[0]

    def query_by_key(self, key: str, payload: bytes = b"", *, timeout: float) -> list[tuple[str, bytes]]:
        return [(key, answer) for answer in self.query(key, payload, timeout=timeout)]

    def ask(self, key: str, payload: bytes, timeout: float, on_answers: Callable[[list[bytes]], None]) -> None:
        """Query without waiting; call `on_answers` once, with all answers that arrive in time."""
        self._enter("query")
        network, kernel = self.network, self.network.kernel
        answers: list[bytes] = []
        servers = network.servers(key) if self.passes() else []
        left, over = len(servers), False

        def end() -> None:
            nonlocal over
            if not over:
                over = True
                on_answers(list(answers))

        def on_answer(answer: bytes | None) -> None:
            nonlocal left
            left -= 1
            if answer is not None:
                answers.append(answer)
            if left == 0:
                end()

        for server, served in servers:
            self._send(server, served, key, payload, timeout, on_answer, finds_others=False)
        if not servers and (self.passes() or network.chance(0.5)):
            timeout = network.delay()
        kernel.after(timeout, Channel(self.process, "answers").deliver, end)

    def query_async(self, key: str, payload: bytes, *, timeout: float, on_answer: OnAnswer) -> None:
        self._enter("query")
        servers = self.network.servers(key) if self.passes() else []
        if servers:
            self._send(*servers[0], key, payload, timeout, on_answer, finds_others=True)
        else:
            query = Query(self, on_answer)
            self.queries[query] = None
            noticed = self.passes() or self.network.chance(self.network.weather.noticed)
            self.network.kernel.after(self.network.delay() if noticed else timeout, query.finish, None)

    def _send(
        self,
        server: "Link",
        served: str,
        key: str,
        payload: bytes,
        timeout: float,
        on_answer: OnAnswer,
        *,
        finds_others: bool,
    ) -> None:
        network, kernel = self.network, self.network.kernel
        query = Query(self, on_answer)
        self.queries[query] = None
        kernel.after(timeout, query.finish, None)
        for _ in range(2 if network.chance(network.weather.duplicated) else 1):
            if network.chance(network.weather.lost):
                kernel.log("query lost", self.process.name, key)
                if network.chance(network.weather.noticed):
                    kernel.after(kernel.random.random(), query.finish, None)
                continue
            request = LinkRequest(server, query, keys.intersection(served, key), payload)
            request.finds_others = finds_others
            self.send(self._arrive, request, served, server.session)

    def _arrive(self, request: LinkRequest, served: str, session: int) -> None:
        network, server = self.network, request.server
        if not server.alive and request.finds_others:
            others = [link for link in network.links if link.alive and served in link.handlers]
            if others:
                request.server = server = others[0]
                session = server.session
        if server.passes() and server.session == session:
            handler, channel = server.handlers[served]
            channel.deliver(handler, request)
        elif network.chance(network.weather.noticed):
            request.query.finish(None)

    def publish(self, key: str, payload: bytes) -> None:
        self._enter("publish")
        network = self.network
        if not self.passes():
            return
        for link in network.links:
            for inbox in link.inboxes:
                if inbox.key == key and not network.chance(network.weather.lost):
                    self.send(inbox.arrive, payload, link.session)

    def subscribe(self, key: str, on_news: Callable[[], None]) -> Inbox:
        inbox = LinkInbox(self, key, on_news)
        self.inboxes.append(inbox)
        return inbox

    def declare_presence(self, key: str) -> Declaration:
        self.tokens[key] = None
        self.network.presence_changed(key)
        return LinkPresence(self, key)

    def watch_presence(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        watch = Watch(self, key, on_change)
        self.watches.append(watch)
        for declared in {declared: None for link in self.network.links for declared in link.tokens}:
            if matches(key, declared):
                watch.look_later(declared)

    def present(self, key: str) -> list[str]:
        return [declared for link in self.network.links for declared in link.tokens if matches(key, declared)]

    def reopen(self, unless_served: str | None = None) -> bool:
        network, kernel = self.network, self.network.kernel
        if self._is_router:
            return False
        kernel.sleep(network.delay())
        if self.cut or network.cut:
            kernel.sleep(kernel.random.random())
            raise TransportError("no router can be reached")
        if unless_served is not None and any(not link.dead for link, _ in network.servers(unless_served)):
            kernel.sleep(network.delay())
            return False
        return self._replace_session()

    def reopen_later(self, on_end: Callable[[], None]) -> None:
        """Open another session without waiting, if the router can be reached; call `on_end` then."""
        network = self.network
        is_cut = self.cut or network.cut
        channel = Channel(self.process, "reopened")
        seconds = network.delay() + (network.kernel.random.random() if is_cut else 0.0)

        def end() -> None:
            if not is_cut:
                self._replace_session()
            on_end()

        network.kernel.after(seconds, channel.deliver, end)

    def _replace_session(self) -> bool:
        if not self.alive:
            return False
        self.network.kernel.log("session reopened", self.process.name)
        self.session += 1
        self.dead = self.expired = False
        for query in list(self.queries):
            query.finish(None)
        self.flicker()
        for watch in self.watches:
            for key in list(watch.told):
                watch.forget(key)
        self._presence_changed()
        return True

    def close(self) -> None:
        if self.network.kernel.current.killed or not self.alive:
            return
        self.alive = False
        for query in list(self.queries):
            query.finish(None)
        # A session that is closed sends all that it has: what was sent before arrives before.
        self.network.kernel.after(self.seconds_to_send, self._remove)
