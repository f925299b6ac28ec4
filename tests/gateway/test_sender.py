"""The threads that wait for the link in place of the event loop: of the sender, and of presence."""

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from processes import LIMIT

from daedalus.gateway.client_uploads import Sender
from daedalus.gateway.presence import Presence
from daedalus.transport.interface import OnAnswer, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class Link(MemoryTransport):
    """A link that can be congested, and a record of what was sent."""

    def __init__(self) -> None:
        super().__init__(MemoryNetwork())
        self.sent: list[bytes] = []
        self.reached, self.is_free = threading.Event(), threading.Event()
        self.is_free.set()
        self.error: Exception | None = None

    def query_async(self, key: str, payload: bytes, *, timeout: float, on_answer: OnAnswer) -> None:
        self.reached.set()
        assert self.is_free.wait(LIMIT)
        if self.error is not None:
            raise self.error
        self.sent.append(payload)


@pytest.fixture
def link() -> Iterator[Link]:
    made = Link()
    yield made
    made.is_free.set()


def send(sender: Sender, payload: bytes, on_answer: OnAnswer = lambda answer: None) -> None:
    sender.query_async("daedalus/r/rollouts/a", payload, timeout=30.0, on_answer=on_answer)


def unexpected(error: Exception) -> None:
    raise error


def test_queries_are_sent_in_order_and_before_the_end(link: Link) -> None:
    sender = Sender(link, unexpected)
    link.is_free.clear()
    sender.open()
    for number in range(100):
        send(sender, bytes([number]))
    assert link.sent == []
    link.is_free.set()
    sender.close(LIMIT)
    assert link.sent == [bytes([number]) for number in range(100)]
    with pytest.raises(TransportError, match="the gateway stops"):
        send(sender, b"late")
    sender.close(LIMIT)


def test_sender_stops_although_the_link_is_congested(link: Link) -> None:
    sender = Sender(link, unexpected)
    link.is_free.clear()
    sender.open()
    send(sender, b"a")
    assert link.reached.wait(LIMIT)
    sender.close(0.01)
    assert link.sent == []


def test_query_that_the_transport_refuses_has_no_answer(link: Link) -> None:
    sender, answers = Sender(link, unexpected), []
    link.error = TransportError("the session was closed")
    sender.open()
    send(sender, b"a", answers.append)
    sender.close(LIMIT)
    assert answers == [None]


def test_error_of_ours_is_reported(link: Link) -> None:
    failures: list[Exception] = []
    sender = Sender(link, failures.append)
    link.error = ValueError("a fault")
    sender.open()
    send(sender, b"a")
    sender.close(LIMIT)
    assert failures == [link.error]


def test_queries_that_wait_are_limited(link: Link, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daedalus.gateway.client_uploads._MAX_QUERIES", 2)
    sender = Sender(link, unexpected)
    send(sender, b"a")
    send(sender, b"b")
    with pytest.raises(TransportError, match="2 queries wait"):
        send(sender, b"c")


def test_client_that_returns_is_present_although_its_withdrawal_was_slow() -> None:
    network = MemoryNetwork()
    transport, present = MemoryTransport(network), {}
    MemoryTransport(network).watch_presence("daedalus/r/actors/*/*", present.__setitem__)
    is_free = threading.Event()

    async def return_at_once(thread: ThreadPoolExecutor) -> None:
        first, second = Presence(transport, thread), Presence(transport, thread)
        await first.declare("daedalus/r/actors/a/1")
        thread.submit(is_free.wait, LIMIT)
        first.withdraw()
        declaring = asyncio.ensure_future(second.declare("daedalus/r/actors/a/1"))
        await asyncio.sleep(0)
        is_free.set()
        await declaring
        assert present == {"daedalus/r/actors/a/1": True}
        await second.declare("daedalus/r2/actors/a/1")
        await second.declare("daedalus/r2/actors/a/1")
        assert transport._present_keys == {"daedalus/r2/actors/a/1"}

    with ThreadPoolExecutor(1) as thread:
        asyncio.run(return_at_once(thread))


def test_declaration_that_is_cancelled_is_withdrawn() -> None:
    transport = MemoryTransport(MemoryNetwork())
    declare_presence, reached, is_free = transport.declare_presence, threading.Event(), threading.Event()

    def congested(key: str) -> Any:
        reached.set()
        assert is_free.wait(LIMIT)
        return declare_presence(key)

    transport.declare_presence = congested  # type: ignore[method-assign] - a congested link

    async def leave_meanwhile(thread: ThreadPoolExecutor) -> None:
        presence = Presence(transport, thread)
        declaring = asyncio.ensure_future(presence.declare("daedalus/r/actors/a/1"))
        await asyncio.to_thread(reached.wait, LIMIT)
        declaring.cancel()
        presence.withdraw()
        is_free.set()

    with ThreadPoolExecutor(1) as thread:
        asyncio.run(leave_meanwhile(thread))
    assert transport._present_keys == set()
