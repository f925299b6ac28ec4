"""Which rollouts are sent when, and what each answer changes."""

import math

import pytest

from daedalus.actor.session.in_flight_rollouts import Uploader
from daedalus.protocol.messages import Acknowledgement


def answer(verdict: str, version: int = 0) -> Acknowledgement:
    return Acknowledgement(verdict=verdict, policy_version=version)  # type: ignore[arg-type] - one of its literals


def test_a_rollout_is_due_at_once_and_then_awaited() -> None:
    uploader = Uploader(window=2)
    uploader.add(0, b"a")
    assert uploader.due(now=10.0) == [(0, b"a")]
    assert uploader.due(now=99.0) == []
    assert uploader.next_due() is None


def test_the_window_has_room_again_once_an_answer_is_final() -> None:
    uploader = Uploader(window=2)
    uploader.add(0, b"a")
    uploader.add(1, b"b")
    assert not uploader.has_room
    uploader.answered(0, answer("busy"), 0.0)
    assert not uploader.has_room
    uploader.answered(0, answer("accepted", 5), 0.0)
    assert uploader.has_room
    assert uploader.newest_version == 5


def test_busy_and_silence_send_again_later_each_time_later() -> None:
    for last in (answer("busy"), None):
        uploader = Uploader(window=1)
        uploader.add(0, b"a")
        waits = []
        for _ in range(14):
            uploader.due(1000.0)
            uploader.answered(0, last, 100.0)
            due = uploader.next_due()
            assert due is not None
            waits.append(due - 100.0)
        assert waits == sorted(waits)
        assert 0 < waits[0] < waits[-1] <= 0.5
        assert uploader.due(100.0) == []
        assert uploader.due(101.0) == [(0, b"a")]


@pytest.mark.parametrize(("last", "longest"), [(answer("busy"), 4.0), (None, 0.5)])
def test_busy_for_long_is_asked_less_often_and_what_was_lost_is_not(
    last: Acknowledgement | None, longest: float
) -> None:
    uploader = Uploader(window=1)
    uploader.add(0, b"a")
    waited, waits = 0.0, []
    for _ in range(40):
        uploader.due(1000.0)
        uploader.answered(0, last, 0.0)
        waits.append(uploader.next_due() or 0.0)
        assert waits[-1] <= waited + 0.1  # hardly ever longer than it has waited already
        waited += waits[-1]
    assert waits[-1] == longest


def test_after_a_lost_connection_all_are_sent_again() -> None:
    uploader = Uploader(window=2)
    uploader.add(0, b"a")
    uploader.add(1, b"b")
    uploader.due(1.0)
    uploader.send_again()
    assert uploader.due(1.0) == [(0, b"a"), (1, b"b")]


def test_answers_to_what_is_not_in_flight_change_nothing() -> None:
    uploader = Uploader(window=1)
    uploader.answered(3, answer("finished", 9), 0.0)
    assert not uploader.over
    assert not uploader.verdicts


def test_rejection_asks_for_a_replacement_and_acceptance_does_not() -> None:
    uploader = Uploader(window=2)
    for sequence, verdict in enumerate(("rejected", "accepted")):
        uploader.add(sequence, b"a")
        uploader.answered(sequence, answer(verdict), 0.0)
        assert uploader.must_replace == (verdict == "rejected")


def test_fenced_and_finished_end_it() -> None:
    for verdict in ("fenced", "finished"):
        uploader = Uploader(window=1)
        uploader.add(0, b"a")
        uploader.answered(0, answer(verdict), 0.0)
        assert uploader.over == verdict


def test_a_quarantine_is_kept_with_its_reason() -> None:
    uploader = Uploader(window=2)
    uploader.add(0, b"a")
    uploader.answered(0, Acknowledgement(verdict="quarantined", reason="why"), 0.0)
    assert (uploader.over, uploader.reason, uploader.in_flight) == ("quarantined", "why", {})


def test_as_many_are_under_way_as_are_played_while_the_fastest_answer_comes() -> None:
    uploader = Uploader(window=1)
    uploader.fit_window(1.0, 1, 4)
    assert uploader.window == 4  # no answer yet: it may take long
    for sequence, seconds in enumerate((9.0, 0.4, 5.0)):
        uploader.add(sequence, b"")
        uploader.due(now=100.0)
        uploader.answered(sequence, answer("accepted"), 100.0 + seconds)
    assert uploader.fastest_answer == pytest.approx(0.4)
    windows = []
    for play_seconds in (10.0, 0.3, 0.15, 0.1, 0.0):
        uploader.fit_window(play_seconds, 1, 4)
        windows.append(uploader.window)
    assert windows == [2, 3, 4, 4, 4]
    uploader.fit_window(10.0, 3, 4)
    assert uploader.window == 3


def test_no_answer_tells_nothing_of_the_link() -> None:
    uploader = Uploader(window=1)
    uploader.add(0, b"")
    uploader.due(now=100.0)
    uploader.answered(0, None, 100.1)
    assert uploader.fastest_answer == math.inf


def test_rejections_in_a_row_are_counted_with_the_last_ones_reason() -> None:
    uploader = Uploader(window=8)
    refused = Acknowledgement(verdict="rejected", reason="policy lag 31, at most 30 is allowed")
    for sequence, last in enumerate((refused, answer("accepted"), refused, answer("busy"), refused)):
        uploader.add(sequence, b"a")
        uploader.answered(sequence, last, 0.0)
    assert (uploader.refused_in_a_row, uploader.reason) == (2, "policy lag 31, at most 30 is allowed")
