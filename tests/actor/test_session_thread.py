"""SessionThread: what it does with the actions of a conversation, over the memory transport."""

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from processes import LIMIT

from daedalus.actor.errors import ActorError
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import Ask, Conversation, Query, Reopen, RunOverError, Steps, Wait, Work
from daedalus.actor.session.session_thread import SessionThread
from daedalus.transport.interface import RefusedError, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class Ends:
    """A thread of a conversation, and its transport."""

    def __init__(self, network: MemoryNetwork) -> None:
        self.transport, self.stop = MemoryTransport(network), threading.Event()
        self.conversation = Conversation(ActorConfig(name="a", incarnation=1))
        self.thread = SessionThread(self.conversation, self.transport, self.stop)


@pytest.fixture
def ends(network: MemoryNetwork) -> Iterator[Ends]:
    made = Ends(network)
    yield made
    made.transport.close()


def steps_of(*actions: Any) -> Steps[list[Any]]:
    came = []
    for action in actions:
        came.append((yield action))
    return came


def raising(error: Exception) -> Any:
    def fail(*_: object, **__: object) -> bool:
        raise error

    return fail


def test_result_is_what_came_of_the_actions(ends: Ends, network: MemoryNetwork) -> None:
    MemoryTransport(network).serve("k", lambda request: request.reply(request.payload + b"!"))
    came = ends.thread.run(steps_of(Ask("k", b"a"), Work(lambda: 5), "mine", Ask("nobody", b"", 0.01)), str.upper)
    assert came == [[b"a!"], 5, "MINE", []]


def test_no_action_follows_a_stop(ends: Ends, network: MemoryNetwork) -> None:
    """Each query may take 5 s, and a process has 5 s to end."""
    asked = []

    def stop(request: Any) -> None:
        asked.append(request.key)
        ends.stop.set()

    MemoryTransport(network).serve("k/*", stop)
    with pytest.raises(RunOverError, match="stopped"):
        ends.thread.run(steps_of(Ask("k/1"), Ask("k/2")))
    assert asked == ["k/1"]
    ends.thread.run(steps_of(Ask("k/3")), to_the_end=True)
    assert asked == ["k/1", "k/3"]


def test_stop_ends_a_wait_and_a_session_that_is_being_reopened(ends: Ends) -> None:
    reopening, ended = threading.Event(), threading.Event()

    def reopen() -> bool:
        reopening.set()
        return ended.wait(LIMIT)

    ends.transport.reopen = reopen  # type: ignore[method-assign] - the network does not answer
    threading.Thread(target=lambda: reopening.wait(LIMIT) and ends.stop.set(), daemon=True).start()
    with pytest.raises(RunOverError, match="stopped"):
        ends.thread.run(steps_of(Reopen()))
    assert not ended.is_set()
    ended.set()
    with pytest.raises(RunOverError, match="stopped"):
        ends.thread.run(steps_of(Wait(None)))


def test_session_that_cannot_be_reopened_goes_on_unless_the_certificate_is_refused(ends: Ends) -> None:
    ends.transport.reopen = raising(TransportError("nothing answers there"))  # type: ignore[method-assign]
    assert ends.thread.run(steps_of(Reopen())) == [None]
    ends.transport.reopen = raising(RefusedError("the certificate expired: renew it"))  # type: ignore[method-assign]
    with pytest.raises(ActorError, match="the certificate expired: renew it"):
        ends.thread.run(steps_of(Reopen()))


def test_event_between_a_step_and_its_wait_ends_the_wait(ends: Ends) -> None:
    """The answer comes on this thread, before the wait begins."""
    answers: list[bytes | None] = []

    def ask() -> Steps[None]:
        ends.conversation.act(Query("nobody", b"", 0.01, lambda answer, _: answers.append(answer)))
        while not answers:
            yield Wait(None)

    ends.thread.run(ask())
    assert answers == [None]


def test_query_that_the_transport_refuses_has_no_answer(ends: Ends) -> None:
    ends.transport.query_async = raising(TransportError("closed"))  # type: ignore[method-assign]
    answers: list[bytes | None] = []
    ends.conversation.act(Query("k", b"", 1.0, lambda answer, _: answers.append(answer)))
    ends.thread.call(lambda: None)
    assert answers == [None]
