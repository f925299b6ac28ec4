"""Fixtures of gateways over the memory transport."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from gateways import JsonClient, RunningGateway
from processes import LIMIT
from scripted_learner import ScriptedLearner

from daedalus.gateway.watching import playing_process
from daedalus.transport.memory import MemoryNetwork


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for the end of a process as long as a busy machine may take."""
    monkeypatch.setattr(playing_process, "_END_SECONDS", LIMIT)
    monkeypatch.setattr(playing_process, "_KILLED_SECONDS", LIMIT)


@pytest.fixture
def learner(network: MemoryNetwork) -> Iterator[ScriptedLearner]:
    """A learner of CartPole with a policy."""
    learner = ScriptedLearner(network)
    learner.publish(0)
    yield learner
    learner.transport.close()


@pytest.fixture
def gateway(network: MemoryNetwork) -> Iterator[RunningGateway]:
    """A gateway that must not fail."""
    running = RunningGateway(network)
    yield running
    running.close()
    assert running.failure is None


@pytest.fixture
def connect(gateway: RunningGateway) -> Iterator[Callable[..., JsonClient]]:
    """Function that returns a connected client."""
    with contextlib.ExitStack() as stack:

        def connect_one(**options: Any) -> JsonClient:
            client = JsonClient(gateway.port, **options)
            stack.callback(client.close)
            return client

        yield connect_one
