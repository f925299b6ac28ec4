"""`daedalus stop`, `checkpoint` and `drain` against a learner whose answers the test writes."""

import pytest
from building import EPOCH
from statuses import actor_status, run_status

from daedalus.cli.commands import orders
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import STATUS_REQUEST_LIMITS
from daedalus.protocol.messages import Acknowledgement, OrderRequest, Refusal, StatusReport
from daedalus.transport.interface import Request
from daedalus.transport.memory import MemoryNetwork, MemoryTransport
from daedalus.transport.operator_orders import Operator, OrderError

ALICE = Operator(name="alice", host="laptop")


class Learner:
    """A learner of the run `mine` with the actor `box`, which leaves after a number of status queries."""

    def __init__(self, network: MemoryNetwork, leaves_after: int = 2) -> None:
        self.transport, self.epoch, self.leaves_after = MemoryTransport(network), EPOCH, leaves_after
        self.received: list[OrderRequest] = []
        self.transport.serve(keys.status("mine"), self._on_status)

    def serve_orders(self) -> None:
        self.transport.serve(keys.orders("mine", "*"), self._on_order)

    def _on_status(self, request: Request) -> None:
        if request.size:
            return
        alive = not self.received or self.leaves_after > 0
        self.leaves_after -= bool(self.received)
        status = run_status(learner_epoch=self.epoch, actors=(actor_status("box", alive=alive),), actors_alive=1)
        request.reply(encode(StatusReport(status=status)))
        if not alive and self.received[-1].order == "stop":
            self.transport.close()

    def _on_order(self, request: Request) -> None:
        message = decode(request.payload, STATUS_REQUEST_LIMITS)
        assert isinstance(message, OrderRequest)
        assert (message.run, message.learner_epoch, message.host) == ("mine", self.epoch, "laptop")
        assert keys.last_chunk(request.key) == "alice"
        self.received.append(message)
        request.reply(encode(Acknowledgement(verdict="accepted", reason=f"{message.order} done")))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orders, "_POLL_SECONDS", 0.001)


def drain(network: MemoryNetwork, *names: str, timeout: float | None = None, run: str = "*") -> None:
    orders.drain_actors(MemoryTransport(network), ALICE, run, list(names) or ["box"], timeout)


def test_command_returns_when_the_actor_has_left(network: MemoryNetwork, capsys: pytest.CaptureFixture[str]) -> None:
    learner = Learner(network)
    learner.serve_orders()
    drain(network)
    assert [(message.order, message.actor) for message in learner.received] == [("drain", "box")]
    assert learner.leaves_after < 0
    assert capsys.readouterr().out.splitlines() == [
        "actor box leaves run 'mine' after its current rollout",
        "actor box has left",
    ]


def test_actor_that_waits_for_a_run_is_drained(network: MemoryNetwork, capsys: pytest.CaptureFixture[str]) -> None:
    actor = MemoryTransport(network)
    token, received = actor.declare_presence(keys.presence(keys.NO_RUN, "idle", 7)), list[OrderRequest]()

    def on_news() -> None:
        message = decode(inbox.take() or b"", STATUS_REQUEST_LIMITS)
        assert isinstance(message, OrderRequest)
        received.append(message)
        if len(received) == 3:  # the others were lost
            token.close()

    inbox = actor.subscribe(keys.orders(keys.NO_RUN, "*"), on_news)
    drain(network, "idle")
    assert {(message.order, message.actor, message.incarnation) for message in received} == {("drain", "idle", 7)}
    assert capsys.readouterr().out == "actor idle has left\n"
    with pytest.raises(OrderError, match=r"^no actor 'idle' waits for a run, and no learner answers at this address"):
        drain(network, "idle")


def test_run_is_stopped_and_saved(network: MemoryNetwork, capsys: pytest.CaptureFixture[str]) -> None:
    learner = Learner(network)
    learner.serve_orders()
    orders.save_checkpoint(MemoryTransport(network), ALICE, "mine")
    orders.stop_run(MemoryTransport(network), ALICE, "mine", None)
    first, second = learner.received
    assert (first.order, second.order) == ("checkpoint", "stop")
    assert first.number != second.number
    assert capsys.readouterr().out.splitlines() == [
        "run 'mine': checkpoint done",
        "run 'mine': stop done",
        "run 'mine': the learner has ended",
    ]
    with pytest.raises(OrderError, match="no learner answers at this address"):
        orders.stop_run(MemoryTransport(network), ALICE, "mine", None)


def test_failures_name_what_to_do(network: MemoryNetwork) -> None:
    learner = Learner(network, leaves_after=10**9)
    with pytest.raises(OrderError, match=r"no actor 'other' takes part or waits .*: `daedalus status` lists them"):
        drain(network, "box", "other")
    with pytest.raises(OrderError, match=r"no learner of run 'other' answers; the runs here are 'mine'$"):
        drain(network, run="other")
    with pytest.raises(OrderError, match=r"^no learner of run 'other' answers; the runs here are 'mine'$"):
        orders.stop_run(MemoryTransport(network), ALICE, "other", None)
    with pytest.raises(OrderError, match=r"does not answer the order: .* the router does not let this certificate"):
        drain(network)
    learner.serve_orders()
    with pytest.raises(OrderError, match=r"still there after 0\.01 s: box; the order remains in force"):
        drain(network, timeout=0.01)
    with pytest.raises(OrderError, match=r"still there after 0\.01 s; the order remains in force"):
        orders.stop_run(MemoryTransport(network), ALICE, "mine", 0.01)


def test_command_ends_when_the_learner_is_restarted_meanwhile(network: MemoryNetwork) -> None:
    learner = Learner(network, leaves_after=10**9)

    def restart(request: Request) -> None:
        learner.epoch += 1
        request.reply(encode(Acknowledgement(verdict="accepted")))

    learner.transport.serve(keys.orders("mine", "*"), restart)
    with pytest.raises(OrderError, match="was restarted; run this command again if needed for: box"):
        drain(network)


def test_refusal_of_the_learner_is_reported(network: MemoryNetwork) -> None:
    learner = Learner(network)
    refusal = encode(Refusal(code="unknown", reason="no actor 'box' takes part"))
    learner.transport.serve(keys.orders("mine", "*"), lambda request: request.reply(refusal))
    with pytest.raises(OrderError, match=r"^no actor 'box' takes part$"):
        drain(network)


def test_of_two_learners_of_one_run_the_newer_decides(network: MemoryNetwork) -> None:
    older, newer = Learner(network), Learner(network)
    newer.epoch = EPOCH + 1
    newer.serve_orders()
    refusal = encode(Refusal(code="mismatch", reason="the order is for another learner process"))
    older.transport.serve(keys.orders("mine", "*"), lambda request: request.reply(refusal))
    drain(network)
    assert len(newer.received) == 1
