"""transport/retries.py: pauses between attempts, and what is logged of them."""

import threading

import pytest
from log_lines import LINES

from daedalus.transport import retries as retries_module
from daedalus.transport.retries import Retries


class Stop(threading.Event):
    """An event that notes how long it is waited for, and lets the clock of the module pass."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.now, self.pauses = 1000.0, list[float]()
        monkeypatch.setattr(retries_module.time, "monotonic", lambda: self.now)

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.pauses.append(timeout)
        self.now += timeout
        return self.is_set()


def test_pauses_grow_to_a_bound_and_differ_between_actors(monkeypatch: pytest.MonkeyPatch) -> None:
    stop = Stop(monkeypatch)
    retries = Retries(stop)
    assert not any(retries.wait("two runs") for _ in range(20))
    for pause, longest in zip(stop.pauses, [1.0, 2.0, 4.0, 8.0, 16.0, *[30.0] * 15], strict=True):
        assert longest / 2 <= pause <= longest
    assert len(set(stop.pauses)) == 20
    retries.succeeded()
    retries.wait("two runs")
    assert stop.pauses[-1] <= 1.0
    retries.wait("two runs")
    stop.now += 61.0  # it took part for so long
    retries.wait("two runs")
    assert stop.pauses[-1] <= 1.0
    stop.set()
    assert retries.wait("two runs")


def test_a_cause_is_logged_once_then_at_growing_intervals_and_when_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    stop = Stop(monkeypatch)
    retries = Retries(stop)
    while stop.now < 1000.0 + 10 * 3600.0:
        retries.wait("no module x")
    lines = [line for line in LINES if line.startswith("no module x")]
    assert lines[0] == "no module x; trying again, at most every 30 s"
    assert 10 <= len(lines) <= 18  # after 1, 3, 7, 15, 31 and 63 minutes, then each hour
    assert lines[1].endswith("attempts have failed so far")
    retries.wait("two runs")
    assert LINES[-1].startswith("two runs; trying again")
