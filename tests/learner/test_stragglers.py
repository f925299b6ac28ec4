"""learner/serving/rollout_buffer.py: a connected actor that delivers nothing does not hold the updates for ever."""

from collections.abc import Set

import pytest
from building import identity, make_rollout

from daedalus.learner.serving.rollout_buffer import BarrierBuffer

LIVE = frozenset({"a", "b", "c"})


class Barrier:
    """Barrier of three actors with a virtual clock. The learner looks every 0.2 s."""

    def __init__(self, first: int = 1) -> None:
        self.buffer = BarrierBuffer(first, lambda: 1 << 30)
        self.now = 50.0
        self.version = 0
        self.batches: list[str] = []  # the actors of each batch
        self.look()

    def look(self, live: Set[str] = LIVE) -> bool:
        taken = self.buffer.take(live, self.version, self.now)
        if taken.rollouts:
            self.batches.append("".join(rollout.identity.actor for rollout in taken.rollouts))
            self.version += 1
        return bool(taken.rollouts)

    def wait(self, seconds: float, live: Set[str] = LIVE) -> None:
        for _ in range(round(seconds / 0.2)):
            self.now += 0.2
            self.look(live)

    def wait_for_batch(self, live: Set[str] = LIVE) -> float:
        """Return the seconds until the next batch."""
        began = self.now
        while not self.look(live):
            self.now += 0.2
            assert self.now < began + 10_000.0, "the barrier waits for ever"
        return self.now - began

    def deliver(self, actors: str) -> None:
        for actor in actors:
            self.buffer.add(make_rollout(identity(actor), rows=1, environments=1))


def test_batch_waits_a_minute_for_an_actor_that_hangs_and_later_batches_do_not_wait() -> None:
    barrier = Barrier()
    barrier.deliver("ab")
    assert barrier.wait_for_batch() == pytest.approx(60.0, abs=0.5)
    assert barrier.batches == ["ab"]
    assert barrier.buffer.left_out == {"c"}
    for _ in range(3):
        barrier.deliver("ab")
        assert barrier.wait_for_batch() == 0.0


def test_late_actor_within_the_patience_is_part_of_the_batch() -> None:
    barrier = Barrier()
    for _ in range(5):
        barrier.deliver("ab")
        barrier.wait(55.0)
        assert barrier.batches.count("abc") == len(barrier.batches)
        barrier.deliver("c")
        assert barrier.wait_for_batch() == 0.0
    assert barrier.batches == ["abc"] * 5
    assert barrier.buffer.left_out == set()


@pytest.mark.parametrize(("duration", "patience"), [(1.0, 60.0), (8.0, 80.0), (100.0, 1000.0)])
def test_patience_is_at_least_ten_rollouts_long(duration: float, patience: float) -> None:
    barrier = Barrier()
    for _ in range(4):
        barrier.wait(duration)
        barrier.deliver("abc")
        barrier.wait_for_batch()
    barrier.wait(duration)
    barrier.deliver("ab")
    assert barrier.wait_for_batch() == pytest.approx(patience - duration, abs=2.0 + 0.01 * patience)
    assert barrier.batches[-1] == "ab"


def test_nobody_is_left_out_while_nobody_delivers() -> None:
    barrier = Barrier()
    barrier.wait(500.0)
    assert barrier.buffer.left_out == set()
    assert barrier.batches == []
    barrier.deliver("abc")
    barrier.look()
    assert barrier.batches == ["abc"]


def test_first_batch_waits_for_all_actors_to_join_but_not_for_one_that_hangs() -> None:
    barrier = Barrier(first=3)
    barrier.deliver("ab")
    barrier.wait(500.0, live={"a", "b"})
    assert barrier.batches == []
    assert barrier.wait_for_batch() == pytest.approx(60.0, abs=0.5)
    assert barrier.batches == ["ab"]


def test_actor_takes_part_again_after_it_sent_a_rollout_that_came_too_late() -> None:
    barrier = Barrier()
    barrier.deliver("ab")
    barrier.wait_for_batch()
    barrier.buffer.heard("c")
    assert barrier.buffer.left_out == set()
    barrier.deliver("ab")
    barrier.wait(10.0)
    barrier.deliver("c")
    barrier.look()
    assert barrier.batches == ["ab", "abc"]


def test_rollout_of_an_actor_that_was_left_out_is_part_of_the_batch() -> None:
    barrier = Barrier()
    barrier.deliver("ab")
    barrier.wait_for_batch()
    barrier.deliver("ca")
    assert not barrier.look()
    barrier.deliver("b")
    assert barrier.look()
    assert barrier.batches == ["ab", "abc"]
    assert barrier.buffer.left_out == set()


def test_actor_that_is_late_again_and_again_is_waited_for_ever_shorter() -> None:
    """It could otherwise hold each update for a minute, by one late rollout for each batch."""
    barrier = Barrier()
    waits = []
    for _ in range(6):
        barrier.deliver("ab")
        waits.append(round(barrier.wait_for_batch()))
        barrier.buffer.heard("c")
    assert waits == [60, 15, 4, 1, 1, 1]


def test_shortest_wait_is_two_rollouts_long() -> None:
    barrier = Barrier()
    for _ in range(4):
        barrier.wait(9.0)
        barrier.deliver("abc")
        barrier.wait_for_batch()
    waited = 0.0
    for _ in range(8):
        barrier.deliver("ab")
        waited = barrier.wait_for_batch()
        barrier.buffer.heard("c")
    assert waited == pytest.approx(18.0, abs=1.0)


def test_a_hundred_rollouts_in_time_make_the_patience_whole_again() -> None:
    barrier = Barrier()
    for in_time, expected in ((0, 60.0), (99, 15.0), (100, 60.0)):
        for _ in range(in_time):
            barrier.deliver("abc")
            assert barrier.wait_for_batch() == 0.0
        barrier.deliver("ab")
        assert barrier.wait_for_batch() == pytest.approx(expected, abs=0.5)
        barrier.buffer.heard("c")


def test_actor_that_leaves_is_no_longer_left_out_and_returns_with_whole_patience() -> None:
    barrier = Barrier()
    barrier.deliver("ab")
    barrier.wait_for_batch()
    barrier.deliver("ab")
    barrier.look(live={"a", "b"})
    assert barrier.buffer.left_out == set()
    barrier.deliver("ab")
    assert barrier.wait_for_batch() == pytest.approx(60.0, abs=0.5)


def test_time_in_which_the_learner_does_not_wait_is_not_counted() -> None:
    """An update, a checkpoint, or a learner that was stopped, is not the actors' fault."""
    barrier = Barrier()
    barrier.deliver("ab")
    for _ in range(20):
        barrier.now += 3600.0
        barrier.look()
    assert barrier.batches == []
    barrier.deliver("c")
    barrier.look()
    assert barrier.batches == ["abc"]


def test_late_actor_of_an_unknown_name_changes_nothing() -> None:
    barrier = Barrier()
    barrier.buffer.heard("nobody")
    barrier.deliver("abc")
    assert barrier.look()
