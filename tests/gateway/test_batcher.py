"""Which clients' actions one call of the policy chooses, and when."""

import asyncio
from typing import Any, cast

import pytest

from daedalus.gateway import batcher
from daedalus.gateway.batcher import Batcher
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_uploads import ClientUploads
from daedalus.gateway.outbox import Outbox
from daedalus.gateway.policy_versions import PolicyVersion


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
