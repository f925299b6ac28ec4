"""FetchSchedule: when the snapshot of the next rollout is requested."""

import pytest

from daedalus.actor.session.snapshots import FetchSchedule


def played(schedule: FetchSchedule, *, start: float, seconds: float, row: float, fetch: float = 0.0) -> list[float]:
    """Play a rollout whose rows take `row` seconds; return the times, since its start, at which a fetch was due."""
    schedule.begin_rollout(start, fetch)
    due = [index * row for index in range(round(seconds / row)) if schedule.is_due(start + index * row)]
    schedule.end_rollout(start + seconds)
    return due


def test_fetch_is_due_once_shortly_before_the_end_of_a_rollout() -> None:
    schedule = FetchSchedule()
    assert played(schedule, start=0.0, seconds=0.8, row=0.01) == []
    for start in (1.0, 2.0, 3.0):
        (at,) = played(schedule, start=start, seconds=0.8, row=0.01, fetch=0.05)
    assert at == pytest.approx(0.8 - (0.05 + 0.01), abs=0.011)


def test_fetch_is_due_from_the_start_if_fetches_take_as_long_as_rollouts() -> None:
    schedule = FetchSchedule()
    played(schedule, start=0.0, seconds=0.8, row=0.01)
    assert played(schedule, start=1.0, seconds=0.8, row=0.01, fetch=0.9) == [0.0]


def test_fetch_is_due_again_ever_more_rarely_in_a_rollout_that_takes_long() -> None:
    schedule = FetchSchedule()
    due = played(schedule, start=0.0, seconds=100.0, row=0.25)
    assert due == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0]


def test_snapshot_is_stale_if_it_was_requested_long_before_the_rollout_begins() -> None:
    schedule = FetchSchedule()
    for start in (0.0, 1.0):
        played(schedule, start=start, seconds=1.0, row=0.01, fetch=0.04)
    assert not schedule.is_stale(2.0, requested_at=1.86)
    assert schedule.is_stale(2.0, requested_at=1.84)


@pytest.mark.parametrize(("fetch", "patience"), [(0.0, 0.1), (0.06, 0.12), (0.5, 0.25)])
def test_patience_grows_with_the_duration_of_fetches_up_to_a_quarter_of_a_rollout(
    fetch: float, patience: float
) -> None:
    schedule = FetchSchedule()
    played(schedule, start=0.0, seconds=1.0, row=0.01)
    schedule.begin_rollout(1.0, fetch)
    assert schedule.patience == pytest.approx(patience)
