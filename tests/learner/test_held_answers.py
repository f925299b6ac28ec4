"""learner/serving/rollout_intake.py: which answers wait, and how long."""

from daedalus.learner.serving.rollout_intake import HeldAnswers
from daedalus.transport.interface import Request


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
