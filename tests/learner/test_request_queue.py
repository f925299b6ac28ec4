"""learner/serving/rollout_intake.py: first in, first out, bounded by bytes, number and waiting time."""

import queue
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daedalus.learner.serving import rollout_intake
from daedalus.learner.serving.rollout_intake import RequestQueue


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
