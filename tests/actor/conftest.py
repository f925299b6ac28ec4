"""Fixtures for tests over the memory transport."""

from collections.abc import Iterator

import pytest
from scripted_learner import RunningActor

from daedalus.transport.memory import MemoryNetwork


@pytest.fixture
def actor(network: MemoryNetwork) -> Iterator[RunningActor]:
    """An actor that runs until the end of the test."""
    running = RunningActor(network)
    yield running
    running.stop.set()
    running.join()
