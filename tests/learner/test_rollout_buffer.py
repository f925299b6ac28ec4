"""learner/serving/rollout_buffer.py: when a batch is complete, and which rollouts it contains."""

from collections.abc import Sequence

import pytest
from building import identity, make_rollout

from daedalus.learner.serving.rollout_buffer import BarrierBuffer, StreamBuffer, TakenRollouts
from daedalus.protocol.uploads import Rollout, Upload


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
