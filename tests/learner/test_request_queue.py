"""learner/serving/request_queue.py: bounded by bytes and by number, first in, first out."""

import threading

from hypothesis import given
from hypothesis import strategies as st

from daedalus.learner.serving.request_queue import RequestQueue


class Asked:
    """A request that nobody waits for."""

    key = "rollouts/a"

    def __init__(self, size: int) -> None:
        self.payload, self.size = bytes(size), size

    def reply(self, payload: bytes) -> None:
        raise AssertionError("a queue answers nothing")


def test_requests_come_out_in_the_order_they_went_in() -> None:
    queue, requests = RequestQueue(100, 100), [Asked(size) for size in (3, 0, 9)]
    assert all(queue.offer(request) for request in requests)
    assert [queue.take() for _ in requests] == requests


def test_a_request_beyond_the_bound_is_refused_until_there_is_room() -> None:
    queue = RequestQueue(10, 100)
    assert queue.offer(Asked(6))
    assert queue.offer(Asked(4))
    assert not queue.offer(Asked(1))
    queue.take()
    assert not queue.offer(Asked(7))
    assert queue.offer(Asked(6))


def test_a_request_beyond_the_number_is_refused_until_one_was_taken() -> None:
    queue = RequestQueue(100, 2)
    assert queue.offer(Asked(0))
    assert queue.offer(Asked(1))
    assert not queue.offer(Asked(1))
    queue.take()
    assert queue.offer(Asked(1))


def test_an_empty_queue_takes_a_request_of_any_size() -> None:
    queue = RequestQueue(10, 100)
    assert queue.offer(Asked(1000))
    assert not queue.offer(Asked(1))
    queue.take()
    assert queue.offer(Asked(1))


@given(st.lists(st.integers(0, 12) | st.none(), max_size=40))
def test_what_is_held_is_what_was_offered_and_not_taken(steps: list[int | None]) -> None:
    queue, held = RequestQueue(20, 5), list[Asked]()
    for size in steps:
        if size is not None:
            request, before = Asked(size), sum(len(each.payload) for each in held)
            fits = not held or (before + size <= 20 and len(held) < 5)
            assert queue.offer(request) == fits
            held += [request] if fits else []
        elif held:
            assert queue.take() is held.pop(0)


def test_after_the_close_what_is_queued_comes_out_and_then_none() -> None:
    queue, request = RequestQueue(10, 100), Asked(1)
    queue.offer(request)
    queue.close()
    assert queue.take() is request
    assert queue.take() is None


def test_take_waits_for_a_request_and_is_woken_by_the_close() -> None:
    queue, request, taken = RequestQueue(10, 100), Asked(1), []

    def work() -> None:
        while (one := queue.take()) is not None:
            taken.append(one)

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    queue.offer(request)
    queue.close()
    worker.join(60.0)
    assert not worker.is_alive()
    assert taken == [request]
