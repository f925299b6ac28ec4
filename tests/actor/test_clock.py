"""actor/client.py with a time that the test makes pass."""

import pytest

from daedalus.actor.client import Clock


class Time:
    def __init__(self) -> None:
        self.now, self.oversleeps = 100.0, 0.0

    def sleep(self, seconds: float) -> None:
        self.now += seconds + self.oversleeps


@pytest.fixture
def time() -> Time:
    return Time()


def clock_of(time: Time, rate: float = 4.0) -> Clock:
    return Clock(rate, now=lambda: time.now, sleep=time.sleep)


def test_ticks_are_a_period_apart_however_long_the_work_takes(time: Time) -> None:
    ticks = []
    with clock_of(time) as clock:
        for work in (0.0, 0.125, 0.25, 0.0):
            assert clock.wait()
            ticks.append(time.now)
            time.now += work
    assert ticks == [100.0, 100.25, 100.5, 100.75]
    assert (clock.deadlines, clock.missed_deadlines) == (3, 0)


@pytest.mark.parametrize(("work", "missed", "tick"), [(0.26, 1, 100.5), (0.5, 1, 100.5), (1.1, 4, 101.25)])
def test_late_loop_goes_on_at_the_next_tick(time: Time, work: float, missed: int, tick: float) -> None:
    clock = clock_of(time)
    clock.wait()
    time.now += work
    clock.wait()
    assert (time.now, clock.missed_deadlines, clock.deadlines) == (tick, missed, 1 + missed)
    clock.wait()
    assert (time.now, clock.missed_deadlines, clock.deadlines) == (tick + 0.25, missed, 2 + missed)


def test_ticks_that_the_operating_system_sleeps_through_are_missed(time: Time) -> None:
    clock = clock_of(time)
    clock.wait()
    time.oversleeps = 0.6
    clock.wait()
    assert clock.missed_deadlines == 2
    time.oversleeps = 0.01
    clock.wait()
    assert clock.missed_deadlines == 2


def test_loop_ends_with_the_run() -> None:
    over = False
    clock = Clock(1000.0, is_over=lambda: over)
    assert clock.wait()
    assert clock.wait()
    over = True
    assert not clock.wait()


@pytest.mark.parametrize("rate", [0.0, -1.0, float("inf"), float("nan")])
def test_rate_is_checked(rate: float) -> None:
    with pytest.raises(ValueError, match="above 0 ticks"):
        Clock(rate)
