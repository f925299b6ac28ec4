"""The contract of every transport; tests of Zenoh alone are at the end.

A fixture closes all sessions: an open session would prevent the process from ending.
"""

import itertools
import queue
import re
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from processes import free_address
from routers import listen_somewhere

from daedalus.transport.interface import AddressInUseError, Request, Transport, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport
from daedalus.transport.zenoh_transport import ZenohTransport, connect, listen

WAIT = 30.0  # seconds; generous, so that only a real fault exceeds it
MakeEnd = Callable[[], Transport]
numbers = itertools.count()


class Tape(queue.SimpleQueue[Any]):
    """A callback that records its arguments; `next` waits for the next call."""

    def __call__(self, *arguments: Any) -> None:
        self.put(arguments[0] if len(arguments) == 1 else arguments)

    def next(self) -> Any:
        return self.get(timeout=WAIT)


def memory_ends() -> MakeEnd:
    network = MemoryNetwork()
    return lambda: MemoryTransport(network)


def zenoh_ends() -> MakeEnd:
    """Return a function that opens a router first, and then its clients."""
    endpoints: list[str] = []

    def make() -> Transport:
        if endpoints:
            return connect(endpoints)
        endpoint, router = listen_somewhere()
        endpoints.append(endpoint)
        return router

    return make


@pytest.fixture
def closing() -> Iterator[Callable[[Transport], Transport]]:
    """Return a function that registers transports to be closed after the test."""
    ends: list[Transport] = []

    def keep(end: Transport) -> Transport:
        ends.append(end)
        return end

    yield keep
    for end in reversed(ends):
        end.close()


@pytest.fixture(params=[memory_ends, zenoh_ends], ids=["memory", "zenoh"])
def make_end(request: pytest.FixtureRequest, closing: Callable[[Transport], Transport]) -> MakeEnd:
    make: MakeEnd = request.param()
    return lambda: closing(make())


@pytest.fixture(params=["router to client", "client to router", "client to client"])
def pair(request: pytest.FixtureRequest, make_end: MakeEnd) -> tuple[Transport, Transport]:
    """Return two transports in every arrangement that Zenoh distinguishes: (server, client of the query)."""
    router, first, second = make_end(), make_end(), make_end()
    constellations = {"router to client": (router, first), "client to router": (first, router)}
    return constellations.get(request.param, (first, second))


def settle(declarer: Transport, other: Transport) -> None:
    """Wait until `other` knows all declarations of `declarer` so far: declarations keep their order."""
    key = f"settled/{next(numbers)}"
    tape = Tape()
    other.watch_presence(key, tape)
    declarer.declare_presence(key)
    assert tape.next() == (key, True)


def echo(request: Request) -> None:
    request.reply(request.key.encode() + b" " + request.payload)


# -------------------------------------------------------------------------------------------- queries


def test_query_is_answered_from_its_key_and_payload(pair: tuple[Transport, Transport]) -> None:
    server, asker = pair
    server.serve("d/r/join", echo)
    settle(server, asker)
    payload = bytes(range(256)) * 1000
    assert asker.query("d/r/join", payload, timeout=WAIT) == [b"d/r/join " + payload]
    assert asker.query("d/r/join", timeout=WAIT) == [b"d/r/join "]


def test_client_knows_the_address_of_its_end(pair: tuple[Transport, Transport]) -> None:
    _, client = pair
    assert re.fullmatch(r"memory|tcp/127\.0\.0\.1:\d+", client.local_address)


def test_transport_answers_its_own_queries(make_end: MakeEnd) -> None:
    end = make_end()
    end.serve("d/r/join", echo)
    assert end.query("d/r/join", b"x", timeout=WAIT) == [b"d/r/join x"]


def test_query_without_a_server_has_no_answers(pair: tuple[Transport, Transport]) -> None:
    server, asker = pair
    server.serve("d/r/join", echo)
    settle(server, asker)
    for key in ("d/r/other", "d/r", "d/r/join/more", "d/other/join"):
        assert asker.query(key, timeout=WAIT) == []


def test_wildcard_of_a_server_matches_one_chunk(pair: tuple[Transport, Transport]) -> None:
    server, asker = pair
    server.serve("d/r/rollouts/*", echo)
    settle(server, asker)
    assert asker.query("d/r/rollouts/a1", b"x", timeout=WAIT) == [b"d/r/rollouts/a1 x"]
    assert asker.query("d/r/rollouts", timeout=WAIT) == []
    assert asker.query("d/r/rollouts/a/b", timeout=WAIT) == []


def test_wildcard_of_a_query_reaches_every_matching_server(make_end: MakeEnd) -> None:
    asker, first, second = make_end(), make_end(), make_end()
    for end, key in ((first, "d/one/status"), (second, "d/two/status"), (second, "d/two/join")):
        end.serve(key, echo)
    settle(first, asker)
    settle(second, asker)
    assert sorted(asker.query("d/*/status", b"x", timeout=WAIT)) == [b"d/one/status x", b"d/two/status x"]


def test_every_server_of_one_key_answers(make_end: MakeEnd) -> None:
    asker, first, second = make_end(), make_end(), make_end()
    first.serve("d/r/status", lambda request: request.reply(b"first"))
    second.serve("d/r/status", lambda request: request.reply(b"second"))
    settle(first, asker)
    settle(second, asker)
    assert sorted(asker.query("d/r/status", timeout=WAIT)) == [b"first", b"second"]
    assert sorted(asker.query("d/*/status", timeout=WAIT)) == [b"first", b"second"]


def test_async_query_is_answered_exactly_once(pair: tuple[Transport, Transport]) -> None:
    server, asker = pair

    def answer_twice(request: Request) -> None:
        request.reply(b"one " + request.payload)
        request.reply(b"two " + request.payload)

    server.serve("d/r/rollouts/*", answer_twice)
    settle(server, asker)
    tape = Tape()
    for index in range(20):
        asker.query_async("d/r/rollouts/a", b"%d" % index, timeout=WAIT, on_answer=tape)
    assert sorted(tape.next() for _ in range(20)) == sorted(b"one %d" % index for index in range(20))
    assert asker.query("d/r/rollouts/a", b"last", timeout=WAIT) == [b"one last"]
    assert tape.empty()


def test_async_query_without_a_server_is_answered_by_none(pair: tuple[Transport, Transport]) -> None:
    _, asker = pair
    tape = Tape()
    asker.query_async("d/r/nobody", b"x", timeout=WAIT, on_answer=tape)
    assert tape.next() is None


def test_request_may_be_answered_later_and_from_another_thread(pair: tuple[Transport, Transport]) -> None:
    server, asker = pair
    requests, answers = Tape(), Tape()
    server.serve("d/r/program/*", requests)
    settle(server, asker)
    asker.query_async("d/r/program/x", b"?", timeout=WAIT, on_answer=answers)
    request = requests.next()
    assert (request.key, request.payload) == ("d/r/program/x", b"?")
    assert answers.empty()
    thread = threading.Thread(target=request.reply, args=(b"!",))
    thread.start()
    thread.join(WAIT)
    assert answers.next() == b"!"
    request.reply(b"again")
    asker.query_async("d/r/nobody", b"", timeout=WAIT, on_answer=answers)  # completes after any effect of "again"
    assert answers.next() is None


def test_dropped_request_is_answered_by_none(make_end: MakeEnd) -> None:
    server, asker = make_end(), make_end()
    server.serve("d/r/join", lambda request: None)
    settle(server, asker)
    assert asker.query("d/r/join", timeout=1.0) == []
    tape = Tape()
    asker.query_async("d/r/join", b"x", timeout=1.0, on_answer=tape)
    assert tape.next() is None


def test_answer_after_the_timeout_is_dropped(make_end: MakeEnd) -> None:
    server, asker = make_end(), make_end()
    requests = Tape()
    server.serve("d/r/join", requests)
    settle(server, asker)
    answers = asker.query("d/r/join", timeout=0.2)
    requests.next().reply(b"late")
    assert answers == []


def test_closed_transport_serves_no_queries(make_end: MakeEnd) -> None:
    asker, server = make_end(), make_end()
    gone = Tape()
    asker.watch_presence("d/r/learner", gone)
    server.serve("d/r/join", echo)
    server.declare_presence("d/r/learner")
    assert gone.next() == ("d/r/learner", True)
    server.close()
    assert gone.next() == ("d/r/learner", False)
    assert asker.query("d/r/join", timeout=WAIT) == []


# ------------------------------------------------------------------------------------------ snapshots


def test_only_the_newest_value_is_kept(pair: tuple[Transport, Transport]) -> None:
    publisher, follower = pair
    news = Tape()
    inbox = follower.subscribe("d/r/snapshots", lambda: news(None))
    settle(follower, publisher)
    assert inbox.take() is None
    for value in (b"1", b"2", b"3" * 100_000):
        publisher.publish("d/r/snapshots", value)
        news.next()  # one by one: on a busy machine a value may be dropped if another is on its way
    assert inbox.take() == b"3" * 100_000
    assert inbox.take() is None
    publisher.publish("d/r/snapshots", b"4")
    news.next()
    assert inbox.take() == b"4"


def test_value_reaches_every_subscriber_of_its_key_only(make_end: MakeEnd) -> None:
    publisher, first, second = make_end(), make_end(), make_end()
    first_news, second_news, other_news = Tape(), Tape(), Tape()
    first_inbox = first.subscribe("d/r/snapshots", lambda: first_news(None))
    other_inbox = second.subscribe("d/q/snapshots", lambda: other_news(None))
    second_inbox = second.subscribe("d/r/snapshots", lambda: second_news(None))
    settle(first, publisher)
    settle(second, publisher)
    publisher.publish("d/r/snapshots", b"x")
    first_news.next()
    second_news.next()
    assert (first_inbox.take(), second_inbox.take(), other_inbox.take()) == (b"x", b"x", None)
    assert other_news.empty()


def test_publishing_without_subscribers_is_allowed(make_end: MakeEnd) -> None:
    make_end().publish("d/r/snapshots", b"x")


# ------------------------------------------------------------------------------------------- presence


def test_watch_reports_present_new_and_ended_keys(pair: tuple[Transport, Transport]) -> None:
    actor, learner = pair
    tape = Tape()
    actor.declare_presence("d/r/actors/early")
    settle(actor, learner)
    learner.watch_presence("d/r/actors/*", tape)
    assert tape.next() == ("d/r/actors/early", True)
    actor.declare_presence("d/q/actors/elsewhere")
    actor.declare_presence("d/r/actors/late")
    assert tape.next() == ("d/r/actors/late", True)
    actor.close()
    assert sorted((tape.next(), tape.next())) == [("d/r/actors/early", False), ("d/r/actors/late", False)]
    assert tape.empty()


def test_every_watch_is_called(make_end: MakeEnd) -> None:
    actor, first, second = make_end(), make_end(), make_end()
    tapes = [Tape(), Tape()]
    first.watch_presence("d/r/actors/*", tapes[0])
    second.watch_presence("d/r/actors/a", tapes[1])
    actor.declare_presence("d/r/actors/a")
    assert [tape.next() for tape in tapes] == [("d/r/actors/a", True)] * 2


def test_presence_lasts_while_any_transport_declares_it(make_end: MakeEnd) -> None:
    learner, first, second = make_end(), make_end(), make_end()
    shared, own = Tape(), Tape()
    for end, key in ((first, "d/r/actors/a"), (second, "d/r/actors/a"), (first, "d/r/own")):
        end.declare_presence(key)
        settle(end, learner)
    learner.watch_presence("d/r/own", own)
    assert own.next() == ("d/r/own", True)
    learner.watch_presence("d/r/actors/*", shared)
    assert shared.next() == ("d/r/actors/a", True)
    while not shared.empty():  # one call for each transport is allowed, as is one for both
        assert shared.next() == ("d/r/actors/a", True)
    first.close()
    assert own.next() == ("d/r/own", False)
    second.declare_presence("d/r/actors/b")
    assert shared.next() == ("d/r/actors/b", True)
    second.close()
    assert sorted((shared.next(), shared.next())) == [("d/r/actors/a", False), ("d/r/actors/b", False)]


def test_presence_can_be_withdrawn_and_declared_again(make_end: MakeEnd) -> None:
    learner, gateway = make_end(), make_end()
    tape = Tape()
    learner.watch_presence("d/r/actors/*", tape)
    first, second = (gateway.declare_presence(f"d/r/actors/{name}") for name in "ab")
    assert sorted((tape.next(), tape.next())) == [("d/r/actors/a", True), ("d/r/actors/b", True)]
    first.close()
    first.close()
    assert tape.next() == ("d/r/actors/a", False)
    gateway.declare_presence("d/r/actors/a")
    assert tape.next() == ("d/r/actors/a", True)
    second.close()
    assert tape.next() == ("d/r/actors/b", False)


def test_close_is_idempotent(make_end: MakeEnd) -> None:
    learner, actor = make_end(), make_end()
    tape = Tape()
    learner.watch_presence("d/r/actors/*", tape)
    actor.declare_presence("d/r/actors/a")
    assert tape.next() == ("d/r/actors/a", True)
    actor.close()
    actor.close()
    assert tape.next() == ("d/r/actors/a", False)
    learner.declare_presence("d/r/actors/own")
    assert tape.next() == ("d/r/actors/own", True)


# ---------------------------------------------------------------------------------------- Zenoh alone


def test_address_in_use_is_reported(closing: Callable[[Transport], Transport]) -> None:
    endpoint, router = listen_somewhere()
    closing(router)
    with pytest.raises(AddressInUseError, match=f"{endpoint} is already in use.*--listen"):
        closing(listen([endpoint]))


def test_impossible_address_is_reported(closing: Callable[[Transport], Transport]) -> None:
    with pytest.raises(TransportError, match="cannot listen on tcp/256"):
        closing(listen(["tcp/256.0.0.1:1"]))


def test_name_without_an_address_is_reported(closing: Callable[[Transport], Transport]) -> None:
    for addresses in (["tcp/nohost.invalid:1"], ["tcp/127.0.0.1:1", "tcp/nohost.invalid:1"]):
        with pytest.raises(TransportError) as refused:
            closing(listen(addresses))
        assert str(refused.value) == (
            f"cannot listen on {', '.join(addresses)}: "
            "'nohost.invalid' cannot be resolved to an address: check the name"
        )


def test_error_of_zenoh_names_no_place_in_its_source(closing: Callable[[Transport], Transport]) -> None:
    with pytest.raises(TransportError) as refused:
        closing(listen(["tcp/192.0.2.1:1"]))  # no address of this machine: reserved for documentation
    assert "Cannot assign requested address" in str(refused.value)
    assert ".rs" not in str(refused.value)


def test_unreachable_address_is_reported_at_once(closing: Callable[[Transport], Transport]) -> None:
    endpoint = free_address()
    refused = Tape()

    def try_to_connect() -> None:
        try:
            closing(connect([endpoint]))
        except TransportError as error:
            refused(str(error))

    threading.Thread(target=try_to_connect, daemon=True).start()
    assert refused.next().startswith(f"nothing answers at {endpoint}: ")


def test_query_is_answered_by_none_after_the_router_closed(closing: Callable[[Transport], Transport]) -> None:
    endpoint, router = listen_somewhere()
    closing(router)
    client = closing(connect([endpoint]))
    requests, answers = Tape(), Tape()
    router.serve("d/r/join", requests)
    settle(router, client)
    client.query_async("d/r/join", b"", timeout=1.0, on_answer=answers)
    requests.next()
    router.close()
    assert answers.next() is None
    assert client.query("d/r/join", timeout=1.0) == []


@pytest.mark.parametrize("act", ["ask", "send", "publish"])
def test_closed_transport_raises_transport_error(act: str, closing: Callable[[Transport], Transport]) -> None:
    end = closing(listen_somewhere()[1])
    end.close()
    acts: dict[str, Callable[[], object]] = {
        "ask": lambda: end.query("d/r/join", timeout=1.0),
        "send": lambda: end.query_async("d/r/join", b"", timeout=1.0, on_answer=Tape()),
        "publish": lambda: end.publish("d/r/snapshots", b""),
    }
    with pytest.raises(TransportError, match="d/r/"):
        acts[act]()


def test_query_over_a_closed_session_either_raises_or_is_answered(closing: Callable[[Transport], Transport]) -> None:
    end = closing(listen_somewhere()[1])
    assert isinstance(end, ZenohTransport)
    ends = Tape()
    end.query_async("d/r/join", b"", timeout=WAIT, on_answer=ends)
    assert ends.next() is None
    end._session.close()  # as another thread that reopens the session does
    for _ in range(20):
        try:
            end.query_async("d/r/join", b"", timeout=WAIT, on_answer=ends)
        except TransportError:
            ends("raised")
    end._callbacks.await_release()
    assert ends.qsize() == 20


def raise_fault(*_arguments: object) -> None:
    raise RuntimeError("a fault of ours")


@pytest.mark.parametrize("callback", ["handler", "answer", "subscriber", "presence"])
def test_exception_in_a_callback_reaches_the_threads_excepthook(
    callback: str, closing: Callable[[Transport], Transport], monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = Tape()
    monkeypatch.setattr(threading, "excepthook", faults)
    endpoint, router = listen_somewhere()
    closing(router)
    client = closing(connect([endpoint]))
    if callback == "handler":
        client.serve("d/r/join", raise_fault)
        settle(client, router)
        assert router.query("d/r/join", timeout=0.5) == []
    elif callback == "answer":
        client.query_async("d/r/join", b"", timeout=WAIT, on_answer=raise_fault)
    elif callback == "subscriber":
        client.subscribe("d/r/snapshots", raise_fault)
        settle(client, router)
        router.publish("d/r/snapshots", b"x")
    else:
        client.watch_presence("d/r/actors/*", raise_fault)
        router.declare_presence("d/r/actors/a")
    fault = faults.next()
    assert (fault.exc_type, str(fault.exc_value)) == (RuntimeError, "a fault of ours")
    assert fault.exc_traceback.tb_next.tb_frame.f_code.co_name in ("raise_fault", "on_query", "on_end", "on_sample")
    assert fault.thread is not None


# ------------------------------------------------------------------------------------------- reopening


def test_routers_and_memory_transports_are_not_reopened(make_end: MakeEnd) -> None:
    assert make_end().reopen() is False


@pytest.fixture
def client(closing: Callable[[Transport], Transport]) -> tuple[Transport, Transport]:
    """Return a router and a client of it."""
    endpoint, router = listen_somewhere()
    return closing(router), closing(connect([endpoint]))


def test_reopened_client_repeats_its_declarations(client: tuple[Transport, Transport]) -> None:
    router, end = client
    news, seen, there = Tape(), Tape(), Tape()
    end.serve("d/r/join", echo)
    inbox = end.subscribe("d/r/snapshots", lambda: news("news"))
    end.declare_presence("d/r/actors/a")
    router.declare_presence("d/r/learner")
    end.watch_presence("d/r/learner", seen)
    router.watch_presence("d/r/actors/*", there)
    router.serve("d/r/status", echo)
    assert (seen.next(), there.next()) == (("d/r/learner", True), ("d/r/actors/a", True))
    answers = Tape()
    end.query_async("d/r/status", b"1", timeout=WAIT, on_answer=answers)
    assert answers.next() == b"d/r/status 1"
    assert end.reopen() is True
    # Present keys are reported as absent first: they may have ended while the session was dead.
    assert [seen.next(), seen.next()] == [("d/r/learner", False), ("d/r/learner", True)]
    afterwards = Tape()  # `there` sees nothing if the router hears of the new session before it hears the old one end
    router.watch_presence("d/r/actors/*", afterwards)
    assert afterwards.next() == ("d/r/actors/a", True)
    settle(end, router)
    assert router.query("d/r/join", b"x", timeout=WAIT) == [b"d/r/join x"]
    router.publish("d/r/snapshots", b"7")
    news.next()
    assert inbox.take() == b"7"
    end.query_async("d/r/status", b"2", timeout=WAIT, on_answer=answers)
    assert answers.next() == b"d/r/status 2"


def test_reopened_client_has_what_other_threads_declare_and_withdraw_meanwhile(
    client: tuple[Transport, Transport],
) -> None:
    router, end = client
    seen, there = Tape(), Tape()
    withdrawn = end.declare_presence("d/r/actors/withdrawn")
    router.declare_presence("d/r/learner")

    def on_change(_key: str, present: bool) -> None:
        if not present:  # the declarations are being repeated
            withdrawn.close()
            end.declare_presence("d/r/actors/new")
        seen(present)

    end.watch_presence("d/r/learner", on_change)
    router.watch_presence("d/r/actors/*", there)
    assert (seen.next(), there.next()) == (True, ("d/r/actors/withdrawn", True))
    assert end.reopen() is True
    assert [seen.next(), seen.next()] == [False, True]
    settle(end, router)
    present: dict[str, bool] = {}
    while present != {"d/r/actors/withdrawn": False, "d/r/actors/new": True}:
        present.update([there.next()])


def test_reachable_client_is_not_reopened(client: tuple[Transport, Transport]) -> None:
    router, end = client
    there = Tape()
    router.watch_presence("d/r/actors/*", there)
    end.serve("d/r/status", echo)
    end.declare_presence("d/r/actors/a")
    assert there.next() == ("d/r/actors/a", True)
    assert end.reopen(unless_served="d/r/status") is False
    assert end.reopen(unless_served="d/r/nobody") is True
    afterwards = Tape()  # `there` sees nothing if the router hears of the new session before it hears the old one end
    router.watch_presence("d/r/actors/*", afterwards)
    assert afterwards.next() == ("d/r/actors/a", True)
    assert end.query("d/r/status", b"x", timeout=WAIT) == [b"d/r/status x"]


def test_client_without_a_router_keeps_its_session(closing: Callable[[Transport], Transport]) -> None:
    endpoint, router = listen_somewhere()
    closing(router)
    end = closing(connect([endpoint]))
    end.serve("d/r/join", echo)
    router.close()
    with pytest.raises(TransportError, match="nothing answers"):
        end.reopen()
    assert end.query("d/r/join", b"x", timeout=WAIT) == [b"d/r/join x"]  # itself


def test_closed_client_is_not_reopened(client: tuple[Transport, Transport]) -> None:
    _, end = client
    end.close()
    assert end.reopen() is False
