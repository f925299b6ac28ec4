"""learner/serving/rollout_buffer.py: when a batch is complete, and of what."""

import pytest
from building import identity, make_rollout

from daedalus.learner.serving.rollout_buffer import BarrierBuffer, StreamBuffer, TakenRollouts
from daedalus.protocol.messages import Rollout


def rollout(actor: str, sequence: int = 0, version: int = 0) -> Rollout:
    return make_rollout(identity(actor, sequence), version=version, rows=1, environments=1)


def actors(taken: TakenRollouts) -> list[str]:
    return [rollout.identity.actor for rollout in taken.rollouts]


def sequences(rollouts: list[Rollout]) -> list[int]:
    return [rollout.identity.sequence for rollout in rollouts]


# -------------------------------------------------------------------------------------------- the barrier


def test_the_barrier_waits_for_every_live_actor_and_orders_them_by_name() -> None:
    buffer, live = BarrierBuffer(1), {"a", "b", "c"}
    for actor in ("c", "a"):
        buffer.add(rollout(actor))
        assert actors(buffer.take(live, 0)) == []
    buffer.add(rollout("b"))
    assert actors(buffer.take(live, 0)) == ["a", "b", "c"]
    assert actors(buffer.take(live, 1)) == []


def test_the_first_batch_waits_for_as_many_actors_as_were_asked_for() -> None:
    buffer = BarrierBuffer(3)
    buffer.add(rollout("a"))
    buffer.add(rollout("b"))
    assert actors(buffer.take({"a", "b"}, 0)) == []
    assert actors(buffer.take({"a", "b", "c"}, 0)) == []
    buffer.add(rollout("c"))
    assert actors(buffer.take({"a", "b", "c"}, 0)) == ["a", "b", "c"]


def test_later_batches_do_not_wait_for_the_first_number() -> None:
    buffer = BarrierBuffer(2)
    buffer.add(rollout("a"))
    buffer.add(rollout("b"))
    assert actors(buffer.take({"a", "b"}, 0)) == ["a", "b"]
    buffer.add(rollout("a"))
    assert actors(buffer.take({"a"}, 1)) == ["a"]


def test_an_actor_that_leaves_is_no_longer_waited_for() -> None:
    buffer = BarrierBuffer(1)
    buffer.add(rollout("a"))
    assert actors(buffer.take({"a", "b"}, 0)) == []
    assert actors(buffer.take({"a"}, 0)) == ["a"]


def test_what_an_actor_sent_before_it_left_counts() -> None:
    buffer = BarrierBuffer(1)
    buffer.add(rollout("b"))
    buffer.add(rollout("a"))
    assert actors(buffer.take({"a"}, 0)) == ["a", "b"]


def test_an_actor_that_comes_later_is_waited_for() -> None:
    buffer = BarrierBuffer(1)
    buffer.add(rollout("a"))
    assert actors(buffer.take({"a", "b"}, 0)) == []
    buffer.add(rollout("b"))
    assert actors(buffer.take({"a", "b"}, 0)) == ["a", "b"]


def test_the_barrier_has_room_for_one_rollout_of_each_actor() -> None:
    buffer = BarrierBuffer(1)
    buffer.add(rollout("a"))
    assert not buffer.has_room_for(rollout("a", 1))
    assert buffer.has_room_for(rollout("b"))
    buffer.take({"a"}, 0)
    assert buffer.has_room_for(rollout("a", 1))


def test_a_barrier_without_rollouts_gives_no_batch() -> None:
    assert actors(BarrierBuffer(0).take(set(), 0)) == []


# --------------------------------------------------------------------------------------------- the stream


def test_the_stream_gives_rollouts_in_the_order_they_came_whoever_sent_them() -> None:
    buffer = StreamBuffer(2, 0)
    for sequence in range(3):
        buffer.add(rollout("a" if sequence % 2 else "b", sequence))
    assert sequences(buffer.take({"a", "b", "c"}, 0).rollouts) == [0, 1]
    assert buffer.take({"a"}, 0).rollouts == []
    buffer.add(rollout("b", 3))
    assert sequences(buffer.take(set(), 0).rollouts) == [2, 3]


def test_the_stream_gives_back_what_grew_too_old() -> None:
    buffer = StreamBuffer(2, 3)
    for sequence, version in enumerate((0, 1, 5, 1, 4)):
        buffer.add(rollout("a", sequence, version))
    taken = buffer.take({"a"}, 5)
    assert sequences(taken.stale) == [0, 1, 3]
    assert sequences(taken.rollouts) == [2, 4]
    assert buffer.take({"a"}, 5).stale == []


def test_a_rollout_exactly_as_old_as_allowed_is_taken() -> None:
    buffer = StreamBuffer(1, 3)
    buffer.add(rollout("a", version=2))
    assert sequences(buffer.take(set(), 5).rollouts) == [0]


def test_stale_rollouts_are_given_back_though_no_batch_is_complete() -> None:
    buffer = StreamBuffer(2, 0)
    buffer.add(rollout("a", 0, version=0))
    buffer.add(rollout("a", 1, version=1))
    taken = buffer.take(set(), 1)
    assert (sequences(taken.rollouts), sequences(taken.stale)) == ([], [0])
    buffer.add(rollout("a", 2, version=1))
    assert sequences(buffer.take(set(), 1).rollouts) == [1, 2]


@pytest.mark.parametrize(("batch", "room"), [(1, 2), (2, 2), (3, 3)])
def test_the_stream_has_room_for_a_batch_and_for_two_rollouts(batch: int, room: int) -> None:
    buffer = StreamBuffer(batch, 0)
    for sequence in range(room):
        assert buffer.has_room_for(rollout("a", sequence))
        buffer.add(rollout("a", sequence))
    assert not buffer.has_room_for(rollout("a", room))
    buffer.take(set(), 0)
    assert buffer.has_room_for(rollout("a", room))
