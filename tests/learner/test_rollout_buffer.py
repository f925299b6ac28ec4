"""What waits in the learner: requests, rollouts of a batch, and answers."""

import queue
import threading
from collections.abc import Sequence

import pytest
from building import identity, make_rollout
from hypothesis import given
from hypothesis import strategies as st

from daedalus.learner.serving import rollout_intake
from daedalus.learner.serving.rollout_buffer import BarrierBuffer, RolloutBuffer, StreamBuffer, TakenRollouts
from daedalus.learner.serving.rollout_intake import HeldAnswers, RequestQueue
from daedalus.protocol.uploads import Rollout, Upload
from daedalus.transport.interface import Request


def rollout(actor: str, sequence: int = 0, version: int = 0) -> Rollout:
    return make_rollout(identity(actor, sequence), version=version, rows=1, environments=1)


def actors(taken: TakenRollouts) -> list[str]:
    return [rollout.identity.actor for rollout in taken.rollouts]


def sequences(rollouts: Sequence[Upload]) -> list[int]:
    return [rollout.identity.sequence for rollout in rollouts]


# -------------------------------------------------------------------------------------------- the barrier


@pytest.mark.parametrize(
    ("first", "steps"),
    [
        (1, ["c abc", "a abc", "b abc -> abc", " abc"]),  # in the order of names; each rollout counts once
        (3, ["a ab", "b ab", " abc", "c abc -> abc"]),  # the first batch waits for the configured number of actors
        (2, ["a ab", "b ab -> ab", "a a -> a"]),  # later ones only for the live
        (1, ["a ab", " a -> a"]),  # not for an actor that has left
        (1, ["b ab", "a a -> ab"]),  # whose rollout is used
        (1, ["a ab", "b ab -> ab"]),  # for one that joins later
        (0, [" "]),
    ],
)
def test_barrier_waits_for_every_live_actor_and_sorts_rollouts_by_name(first: int, steps: list[str]) -> None:
    """Each step: the actor whose rollout arrives, the live actors, and those of the batch that is then complete."""
    buffer = BarrierBuffer(first, lambda: 1 << 30)
    for version, step in enumerate(steps):
        (arrived, live), batch = step.partition(" -> ")[0].split(" "), step.partition(" -> ")[2]
        if arrived:
            buffer.add(rollout(arrived))
        assert actors(buffer.take(set(live), version, 0.0)) == list(batch), step


def test_barrier_has_room_for_one_rollout_of_each_actor() -> None:
    buffer = BarrierBuffer(1, lambda: 1 << 30)
    buffer.add(rollout("a"))
    assert not buffer.has_room_for(rollout("a", 1))
    assert buffer.has_room_for(rollout("b"))
    buffer.take({"a"}, 0, 0.0)
    assert buffer.has_room_for(rollout("a", 1))


def test_batch_of_the_barrier_is_complete_when_its_rollouts_fill_the_memory(caplog: pytest.LogCaptureFixture) -> None:
    size = rollout("a").nbytes
    buffer, live = BarrierBuffer(4, lambda: 2 * size), {"a", "b", "c", "d"}
    buffer.add(rollout("a"))
    assert actors(buffer.take(live, 0, 0.0)) == []
    assert buffer.has_room_for(rollout("b"))
    buffer.add(rollout("b"))
    assert not buffer.has_room_for(rollout("c"))
    assert actors(buffer.take(live, 0, 0.0)) == ["a", "b"]
    assert "a batch has only 2 rollouts" in caplog.text
    buffer.add(rollout("c"))
    assert actors(buffer.take(live, 1, 0.0)) == []
    assert buffer.has_room_for(rollout("d"))


# --------------------------------------------------------------------------------------------- the stream


def test_stream_returns_rollouts_of_all_actors_in_order_of_arrival() -> None:
    buffer = StreamBuffer(2, lambda _live: 0)
    for sequence in range(3):
        buffer.add(rollout("a" if sequence % 2 else "b", sequence))
    assert sequences(buffer.take({"a", "b", "c"}, 0, 0.0).rollouts) == [0, 1]
    assert buffer.take({"a"}, 0, 0.0).rollouts == []
    buffer.add(rollout("b", 3))
    assert sequences(buffer.take(set(), 0, 0.0).rollouts) == [2, 3]


@pytest.mark.parametrize("buffer", [StreamBuffer(3, lambda _live: 0), BarrierBuffer(2, lambda: 1 << 30)])
def test_at_the_end_of_a_run_what_is_there_is_a_batch(buffer: RolloutBuffer) -> None:
    buffer.add(rollout("a"))
    assert buffer.take({"a", "b"}, 0, 0.0).rollouts == []
    assert actors(buffer.take({"a", "b"}, 0, 0.0, complete=False)) == ["a"]
    assert buffer.take({"a", "b"}, 0, 0.0, complete=False).rollouts == []


def test_stream_returns_stale_rollouts_separately() -> None:
    buffer = StreamBuffer(2, lambda _live: 3)
    for sequence, version in enumerate((0, 1, 5, 1, 2)):  # the last at the bound
        buffer.add(rollout("a", sequence, version))
    taken = buffer.take({"a"}, 5, 0.0)
    assert sequences(taken.stale) == [0, 1, 3]
    assert sequences(taken.rollouts) == [2, 4]
    assert buffer.take({"a"}, 5, 0.0).stale == []


def test_stream_returns_stale_rollouts_when_no_batch_is_complete() -> None:
    buffer = StreamBuffer(2, lambda _live: 0)
    buffer.add(rollout("a", 0, version=0))
    buffer.add(rollout("a", 1, version=1))
    taken = buffer.take(set(), 1, 0.0)
    assert (sequences(taken.rollouts), sequences(taken.stale)) == ([], [0])
    buffer.add(rollout("a", 2, version=1))
    assert sequences(buffer.take(set(), 1, 0.0).rollouts) == [1, 2]


@pytest.mark.parametrize(("batch", "room"), [(1, 2), (2, 2), (3, 3)])
def test_stream_has_room_for_a_batch_and_at_least_two_rollouts(batch: int, room: int) -> None:
    buffer = StreamBuffer(batch, lambda _live: 0)
    for sequence in range(room):
        assert buffer.has_room_for(rollout("a", sequence))
        buffer.add(rollout("a", sequence))
    assert not buffer.has_room_for(rollout("a", room))
    buffer.take(set(), 0, 0.0)
    assert buffer.has_room_for(rollout("a", room))


class UnansweredRequest:
    """Request that must not be answered."""

    key = "rollouts/a"

    def __init__(self, size: int) -> None:
        self.payload, self.size = bytes(size), size

    def reply(self, payload: bytes) -> None:
        raise AssertionError("the queue must not reply")


def taken(queue: RequestQueue) -> object:
    """Return the next request, or None."""
    entry = queue.take()
    return None if entry is None else entry[1]


def test_requests_are_refused_while_the_oldest_has_waited_long(monkeypatch: pytest.MonkeyPatch) -> None:
    queue = RequestQueue(100, 100)
    assert queue.offer(UnansweredRequest(1))
    assert queue.offer(UnansweredRequest(1))
    monkeypatch.setattr(rollout_intake, "_OLDEST_SECONDS", -1.0)  # each waiting request has waited too long
    assert not queue.offer(UnansweredRequest(1))
    queue.take()
    queue.take()
    assert queue.offer(UnansweredRequest(1))


def test_requests_that_have_waited_too_long_are_taken_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    queue, requests = RequestQueue(100, 100), [UnansweredRequest(size) for size in (3, 4)]
    assert all(queue.offer(request) for request in requests)
    assert queue.take_late() == []
    monkeypatch.setattr(rollout_intake, "LATE_SECONDS", -1.0)
    assert queue.take_late() == requests
    assert (queue.bytes, queue.take_late()) == (0, [])


@given(st.lists(st.integers(0, 12) | st.just(1000) | st.none(), max_size=40))
def test_queue_equals_a_bounded_list_model(steps: list[int | None]) -> None:
    queue, held = RequestQueue(20, 5), list[UnansweredRequest]()
    for size in steps:
        if size is not None:
            request, before = UnansweredRequest(size), sum(len(each.payload) for each in held)
            fits = not held or (before + size <= 20 and len(held) < 5)
            assert queue.offer(request) == fits
            held += [request] if fits else []
        elif held:
            assert taken(queue) is held.pop(0)


def test_take_returns_queued_requests_and_then_none_after_close() -> None:
    queue, request = RequestQueue(10, 100), UnansweredRequest(1)
    queue.offer(request)
    queue.close()
    assert taken(queue) is request
    assert queue.take() is None


def test_take_blocks_until_a_request_or_close() -> None:
    queue, request, served = RequestQueue(10, 100), UnansweredRequest(1), []

    def work() -> None:
        while (one := taken(queue)) is not None:
            served.append(one)

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    queue.offer(request)
    queue.close()
    worker.join(60.0)
    assert not worker.is_alive()
    assert served == [request]


def test_a_woken_queue_raises_once_and_keeps_its_requests() -> None:
    waiting, request = RequestQueue(100, 100), UnansweredRequest(3)
    waiting.wake()
    waiting.offer(request)
    with pytest.raises(queue.Empty):
        waiting.take()
    assert taken(waiting) is request


class Waiting:
    """Request that nobody reads or answers here."""

    key, payload, size = "rollouts/a", b"", 0

    def reply(self, payload: bytes) -> None:
        raise AssertionError("the caller replies")


def test_answers_wait_until_they_are_released() -> None:
    held, first, second = HeldAnswers(), Waiting(), Waiting()
    assert not held.holds
    held.begin(100.0)
    assert held.holds
    for request in (first, second):
        held.add(request)
    assert held.take(109.0) == []
    held.release()
    taken: list[Request] = held.take(109.0)
    assert taken == [first, second]
    assert (held.holds, held.take(109.0)) == (False, [])


def test_answers_of_a_long_batch_wait_10_seconds() -> None:
    held, request = HeldAnswers(), Waiting()
    held.begin(100.0)
    held.add(request)
    assert held.take(110.0) == []
    assert held.take(110.1) == [request]
    assert not held.holds  # until the next batch: later answers need not wait either


def test_released_answers_do_not_wait_for_the_batch_that_begins_at_once() -> None:
    held, first, second = HeldAnswers(), Waiting(), Waiting()
    held.begin(100.0)
    held.add(first)
    held.release()
    held.begin(101.0)
    held.add(second)
    assert held.take(102.0) == [first]
    assert held.take(102.0) == []
