"""`daedalus drain` against a learner whose answers the test writes."""

import pytest
from building import EPOCH
from statuses import actor_status, run_status

from daedalus.cli.commands import drain
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Acknowledgement, Refusal, StatusReport
from daedalus.transport.interface import Request
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class Learner:
    """A learner of the run `mine` with the actor `box`, which leaves after a number of status queries."""

    def __init__(self, network: MemoryNetwork, leaves_after: int = 2) -> None:
        self.transport, self.epoch, self.leaves_after = MemoryTransport(network), EPOCH, leaves_after
        self.drained: list[str] = []
        self.transport.serve(keys.status("mine"), self._on_status)

    def serve_drain(self) -> None:
        self.transport.serve(keys.drain("mine", "*"), self._on_drain)

    def _on_status(self, request: Request) -> None:
        alive = not self.drained or self.leaves_after > 0
        self.leaves_after -= bool(self.drained)
        status = run_status(learner_epoch=self.epoch, actors=(actor_status("box", alive=alive),), actors_alive=1)
        request.reply(encode(StatusReport(status=status)))

    def _on_drain(self, request: Request) -> None:
        self.drained.append(keys.last_chunk(request.key))
        request.reply(encode(Acknowledgement(verdict="accepted")))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drain, "_POLL_SECONDS", 0.001)


@pytest.fixture
def network() -> MemoryNetwork:
    return MemoryNetwork()


def drained(network: MemoryNetwork, name: str = "box", timeout: float | None = None, run: str = "*") -> None:
    drain.drain_actors(MemoryTransport(network), run, [name], timeout)


def test_command_returns_when_the_actor_has_left(network: MemoryNetwork, capsys: pytest.CaptureFixture[str]) -> None:
    learner = Learner(network)
    learner.serve_drain()
    drained(network)
    assert learner.drained == ["box"]
    assert learner.leaves_after < 0
    assert capsys.readouterr().out.splitlines() == [
        "actor box leaves run 'mine' after its current rollout",
        "actor box has left",
    ]


def test_failures_name_what_to_do(network: MemoryNetwork) -> None:
    with pytest.raises(drain.DrainError, match="is a learner running"):
        drained(network)
    learner = Learner(network, leaves_after=10**9)
    with pytest.raises(drain.DrainError, match=r"no actor 'other' takes part: `daedalus status` lists them"):
        drained(network, "other")
    with pytest.raises(drain.DrainError, match=r"^no learner of run 'other' answers; the runs here are 'mine'$"):
        drained(network, run="other")
    with pytest.raises(drain.DrainError, match="run 'mine' does not answer: run this command again"):
        drained(network)
    learner.serve_drain()
    with pytest.raises(drain.DrainError, match=r"still there after 0\.01 s: box; the request remains in force"):
        drained(network, timeout=0.01)


def test_command_ends_when_the_learner_is_restarted_meanwhile(network: MemoryNetwork) -> None:
    learner = Learner(network, leaves_after=10**9)

    def restart(request: Request) -> None:
        learner.epoch += 1
        request.reply(encode(Acknowledgement(verdict="accepted")))

    learner.transport.serve(keys.drain("mine", "*"), restart)
    with pytest.raises(drain.DrainError, match="was restarted; run this command again if needed for: box"):
        drained(network)


def test_refusal_of_the_learner_is_reported(network: MemoryNetwork) -> None:
    learner = Learner(network)
    refusal = encode(Refusal(code="unknown", reason="no actor 'box' takes part"))
    learner.transport.serve(keys.drain("mine", "*"), lambda request: request.reply(refusal))
    with pytest.raises(drain.DrainError, match=r"^no actor 'box' takes part$"):
        drained(network)


def test_of_two_learners_of_one_run_the_newer_decides(network: MemoryNetwork) -> None:
    older, newer = Learner(network), Learner(network)
    newer.epoch = EPOCH + 1
    newer.serve_drain()
    refusal = encode(Refusal(code="unknown", reason="no actor 'box' takes part"))
    older.transport.serve(keys.drain("mine", "*"), lambda request: request.reply(refusal))
    drained(network)
    assert newer.drained == ["box"]
