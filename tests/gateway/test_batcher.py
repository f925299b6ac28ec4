"""Which clients' actions one call chooses, and the threads that wait for the link in place of the event loop."""

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest
from processes import LIMIT

from daedalus.actor.collecting.rollout_writer import RowInputs
from daedalus.actor.session.conversation import Query
from daedalus.gateway import batcher
from daedalus.gateway.batcher import Batcher
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_uploads import ClientUploads, Outbox, Sender
from daedalus.gateway.joining import Presence
from daedalus.gateway.policy_versions import PolicyVersion
from daedalus.policy.acting.noise import Noise, NoiseSize, neutral_noise
from daedalus.policy.acting.runtime import Choice
from daedalus.transport.interface import OnAnswer, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class WaitingClient:
    """A client that waits for an action, or has rollouts to send."""

    def __init__(self, name: str, rollouts: int = 0, tape: list[str] | None = None) -> None:
        self.name, self.rollouts, self.tape = name, rollouts, tape if tape is not None else []

    def select_version(self, current: PolicyVersion) -> PolicyVersion:
        return current

    @property
    def can_send(self) -> bool:
        return self.rollouts > 0

    def send_one(self) -> None:
        self.rollouts -= 1
        self.tape.append(self.name)


def client(name: str) -> ClientActor:
    return cast(ClientActor, WaitingClient(name))


def fault(actor: ClientActor, error: Exception) -> None:
    pytest.fail(f"{actor.name}: {error}")


async def turns(count: int = 3) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


def test_client_waits_for_others_only_after_a_call_and_while_others_may_come(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batcher, "_PAUSE_SECONDS", 1000.0)
    calls: list[list[str]] = []
    monkeypatch.setattr(Batcher, "_choose", lambda self, version, actors: calls.append([each.name for each in actors]))

    async def run() -> None:
        first, second = client("first"), client("second")
        chooser = Batcher(lambda: cast(Any, "version"), lambda: 2, lambda error: pytest.fail(str(error)), fault)
        chooser.add(first)
        await turns()
        assert calls == [["first"]], "an idle gateway chooses at once"
        chooser.add(first)
        await turns()
        assert calls == [["first"]], "the next call waits for others"
        chooser.add(second)
        await turns()
        assert calls == [["first"], ["first", "second"]], "all wait: nobody else can come"

    asyncio.run(run())


def test_each_turn_of_the_loop_sends_one_rollout() -> None:
    tape: list[str] = []

    async def run() -> None:
        outbox = Outbox()
        for uploads in (WaitingClient("a", 2, tape), WaitingClient("b", 1, tape)):
            outbox.add(cast(ClientUploads, uploads))
        while tape.count("a") < 2:
            await asyncio.sleep(0)
            tape.append("|")

    asyncio.run(run())
    assert [entry for entry in tape if entry != "|"] == ["a", "b", "a"]
    assert "|" in tape[tape.index("a") + 1 : tape.index("b")], "clients are answered between two rollouts"


class Echo:
    """A runtime whose choices say which inputs, and which version, they were made from."""

    noise_size = NoiseSize(1, 0)

    def __init__(self, version: int) -> None:
        self.version, self.rows = version, list[int]()

    def act(self, observations: Any, state: Any, noise: Noise, masks: Any, epsilon: Any) -> Choice:
        self.rows.append(len(state))
        assert len(noise.uniform) == len(epsilon) == len(masks["a"]) == len(state)
        actions = {"a": observations["o"][:, :1], "mask": masks["a"][:, :1], "version": 0 * epsilon + self.version}
        return Choice(actions, epsilon[:, 0], state + 0.5)


@dataclass(frozen=True, eq=False)
class Version:
    runtime: Echo


class Choosing(WaitingClient):
    """A client that keeps its choices, and whose first ones were for reset rows."""

    def __init__(self, number: int, version: Any = None, resets: int = 0) -> None:
        super().__init__(f"c-{number}")
        self.number, self.version, self.resets = number, version, resets
        self.taken: list[list[float]] = []

    def select_version(self, current: Any) -> Any:
        return self.version or current

    def begin_row(self) -> RowInputs:
        one = np.full((1, 1), self.number, np.float32)
        return RowInputs({"o": one}, one + 1000.0, {"a": one + 2000.0}, one + 3000.0, neutral_noise(NoiseSize(1, 1), 1))

    def take(self, choice: Choice) -> bool:
        parts = [*choice.actions.values(), choice.log_probs, choice.state]
        self.taken.append([float(part.item()) for part in parts])
        return len(self.taken) > self.resets


def test_each_client_has_the_choice_for_its_own_row_by_its_own_version(monkeypatch: pytest.MonkeyPatch) -> None:
    """More clients than one call takes, some of which still fill a rollout of an older version."""
    monkeypatch.setattr(batcher, "_MAX_ROWS", 4)
    monkeypatch.setattr(batcher, "_PAUSE_SECONDS", 0.0)
    old, new = Version(Echo(1)), Version(Echo(2))
    clients = [Choosing(number, old if number % 3 == 0 else None, resets=int(number == 5)) for number in range(15)]

    faults: list[object] = []  # an exception in a callback of the event loop would only be logged

    async def run() -> None:
        noted = faults.append
        chooser = Batcher(lambda: cast(Any, new), lambda: 100, noted, lambda actor, error: noted((actor.name, error)))
        for each in clients:
            chooser.add(cast(ClientActor, each))
        left = Choosing(99)
        chooser.add(cast(ClientActor, left))
        chooser.remove(cast(ClientActor, left))
        async with asyncio.timeout(LIMIT):
            while any(len(each.taken) <= each.resets for each in clients) and not faults:
                await asyncio.sleep(0.001)
        assert not left.taken

    asyncio.run(run())
    assert not faults
    for each in clients:
        version = 1.0 if each.version is old else 2.0
        own = float(each.number)
        assert each.taken == [[own, own + 2000.0, version, own + 3000.0, own + 1000.5]] * (1 + each.resets)
    assert (old.runtime.rows, new.runtime.rows) == ([4, 1], [4, 4, 2, 1])


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
    sender.send(Query("daedalus/r/rollouts/a", payload, 30.0, lambda answer, _: on_answer(answer)))


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
    answers: list[bytes | None] = []
    send(sender, b"late", answers.append)
    assert answers == [None]
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
    answers: list[bytes | None] = []
    for payload in (b"b", b"c"):
        send(sender, payload, answers.append)
    assert answers == [None]


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
