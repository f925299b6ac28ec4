"""InFlightRollouts: which rollouts are sent when, and what each acknowledgement changes."""

import math

import pytest

from daedalus.actor.session.uploading import InFlightRollouts
from daedalus.protocol.messages import Acknowledgement


def answer(verdict: str, version: int = 0) -> Acknowledgement:
    return Acknowledgement(verdict=verdict, policy_version=version)  # type: ignore[arg-type] - one of its literals


def test_new_rollout_is_due_once() -> None:
    in_flight = InFlightRollouts(window=2)
    in_flight.add(0, b"a")
    assert in_flight.take_due(now=10.0) == [(0, b"a")]
    assert in_flight.take_due(now=99.0) == []
    assert in_flight.next_due() is None


def test_window_has_room_again_after_a_final_acknowledgement() -> None:
    in_flight = InFlightRollouts(window=2)
    in_flight.add(0, b"a")
    in_flight.add(1, b"b")
    assert not in_flight.has_room
    in_flight.acknowledge(0, answer("busy"), 0.0)
    assert not in_flight.has_room
    in_flight.acknowledge(0, answer("accepted", 5), 0.0)
    assert in_flight.has_room
    assert in_flight.newest_version == 5


def test_retry_delay_grows_after_busy_and_without_an_answer() -> None:
    for last in (answer("busy"), None):
        in_flight = InFlightRollouts(window=1)
        in_flight.add(0, b"a")
        waits = []
        for _ in range(14):
            in_flight.take_due(1000.0)
            in_flight.acknowledge(0, last, 100.0)
            due = in_flight.next_due()
            assert due is not None
            waits.append(due - 100.0)
        assert waits == sorted(waits)
        assert 0 < waits[0] < waits[-1] <= 0.5
        assert in_flight.take_due(100.0) == []
        assert in_flight.take_due(101.0) == [(0, b"a")]


@pytest.mark.parametrize(("last", "longest"), [(answer("busy"), 4.0), (None, 0.5)])
def test_retry_delay_exceeds_half_a_second_only_after_many_busy_answers(
    last: Acknowledgement | None, longest: float
) -> None:
    in_flight = InFlightRollouts(window=1)
    in_flight.add(0, b"a")
    waited, waits = 0.0, []
    for _ in range(40):
        in_flight.take_due(1000.0)
        in_flight.acknowledge(0, last, 0.0)
        waits.append(in_flight.next_due() or 0.0)
        assert waits[-1] <= waited + 0.1  # hardly ever longer than the wait so far
        waited += waits[-1]
    assert waits[-1] == longest


def test_resend_all_makes_every_rollout_due() -> None:
    in_flight = InFlightRollouts(window=2)
    in_flight.add(0, b"a")
    in_flight.add(1, b"b")
    in_flight.take_due(1.0)
    in_flight.resend_all()
    assert in_flight.take_due(1.0) == [(0, b"a"), (1, b"b")]


def test_acknowledgement_of_an_unknown_rollout_changes_nothing() -> None:
    in_flight = InFlightRollouts(window=1)
    in_flight.acknowledge(3, answer("finished", 9), 0.0)
    assert not in_flight.ended_by
    assert not in_flight.verdicts


def test_last_was_rejected_after_a_rejection_only() -> None:
    in_flight = InFlightRollouts(window=2)
    for sequence, verdict in enumerate(("rejected", "accepted")):
        in_flight.add(sequence, b"a")
        in_flight.acknowledge(sequence, answer(verdict), 0.0)
        assert in_flight.last_was_rejected == (verdict == "rejected")


def test_fenced_and_finished_end_the_session() -> None:
    for verdict in ("fenced", "finished"):
        in_flight = InFlightRollouts(window=1)
        in_flight.add(0, b"a")
        in_flight.acknowledge(0, answer(verdict), 0.0)
        assert in_flight.ended_by == verdict


def test_quarantine_is_stored_with_its_reason() -> None:
    in_flight = InFlightRollouts(window=2)
    in_flight.add(0, b"a")
    in_flight.acknowledge(0, Acknowledgement(verdict="quarantined", reason="why"), 0.0)
    assert (in_flight.ended_by, in_flight.reason, in_flight.rollouts) == ("quarantined", "why", {})


def test_window_is_sized_to_the_latency_of_the_fastest_answer() -> None:
    in_flight = InFlightRollouts(window=1)
    in_flight.size_window(1.0, 1, 4)
    assert in_flight.window == 4  # no answer yet: the latency may be high
    for sequence, seconds in enumerate((9.0, 0.4, 5.0)):
        in_flight.add(sequence, b"")
        in_flight.take_due(now=100.0)
        in_flight.acknowledge(sequence, answer("accepted"), 100.0 + seconds)
    assert in_flight.fastest_answer == pytest.approx(0.4)
    windows = []
    for play_seconds in (10.0, 0.3, 0.15, 0.1, 0.0):
        in_flight.size_window(play_seconds, 1, 4)
        windows.append(in_flight.window)
    assert windows == [2, 3, 4, 4, 4]
    in_flight.size_window(10.0, 3, 4)
    assert in_flight.window == 3


def test_missing_answer_leaves_the_fastest_answer_unknown() -> None:
    in_flight = InFlightRollouts(window=1)
    in_flight.add(0, b"")
    in_flight.take_due(now=100.0)
    in_flight.acknowledge(0, None, 100.1)
    assert in_flight.fastest_answer == math.inf


def test_consecutive_rejections_are_counted_with_the_last_reason() -> None:
    in_flight = InFlightRollouts(window=8)
    refused = Acknowledgement(verdict="rejected", reason="policy lag 31, at most 30 is allowed")
    for sequence, last in enumerate((refused, answer("accepted"), refused, answer("busy"), refused)):
        in_flight.add(sequence, b"a")
        in_flight.acknowledge(sequence, last, 0.0)
    assert (in_flight.rejections_in_a_row, in_flight.reason) == (2, "policy lag 31, at most 30 is allowed")
