"""actor/session/compact_snapshot_fetcher.py over the memory transport, against the learner's answers."""

import queue

import numpy as np
import pytest
from processes import LIMIT

from daedalus.actor.session import compact_snapshot_fetcher as compact_snapshots
from daedalus.actor.session.compact_snapshot_fetcher import CompactSnapshotFetcher
from daedalus.learner.serving.compact_snapshot_cache import CompactSnapshotCache
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import bfloat16, float32
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Message, RunEnded, Snapshot, SnapshotPart, SnapshotRequest
from daedalus.transport.interface import Request
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

FIRST = {"w": np.random.default_rng(1).normal(size=(500, 800)).astype(np.float32)}


class Learner:
    """Hands every request to the test, which has it answered."""

    def __init__(self, network: MemoryNetwork) -> None:
        self.transport = MemoryTransport(network)
        self.requests: queue.SimpleQueue[Request] = queue.SimpleQueue()
        self.transport.serve(keys.snapshots("r"), self.requests.put)
        self.cache = CompactSnapshotCache(5)
        self.version = 1

    @property
    def weights(self) -> dict[str, np.ndarray]:
        return {name: array * np.float32(1 + 1e-3 * self.version) for name, array in FIRST.items()}

    def answer(self, count: int | None = None, *, taking: bool = True) -> list[SnapshotRequest]:
        """Answers what was asked, and what is asked then; an actor that plays meanwhile takes nothing."""
        asked = []
        while not self.requests.empty() and (count is None or len(asked) < count):
            request = self.requests.get()
            message = decode(request.payload, Limits())
            assert isinstance(message, SnapshotRequest)
            asked.append(message)
            newest = Snapshot(learner_epoch=5, policy_version=self.version, program="p", weights=self.weights)
            request.reply(self.cache.answer(message, encode(newest)))
            del request
            if taking:
                self.link.take_into(self.taken)
        return asked

    link: "Link"
    taken: list[Message]


class Link(CompactSnapshotFetcher):
    def take_into(self, taken: list[Message]) -> None:
        message = self.take()
        if message is not None:
            taken.append(message)


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> tuple[Learner, Link]:
    monkeypatch.setattr(compact_snapshots, "_RETRY_SECONDS", 0.0)
    network = MemoryNetwork()
    learner = Learner(network)
    learner.link, learner.taken = Link(MemoryTransport(network), "r", "a", lambda: None), []
    return learner, learner.link


def rested(link: CompactSnapshotFetcher) -> None:
    link._next_at = 0.0


def test_the_first_is_whole_and_the_next_is_a_difference(ends: tuple[Learner, Link]) -> None:
    learner, link = ends
    sizes = []
    for version in (1, 2, 7):
        learner.version = version
        rested(link)
        link.want()
        asked = learner.answer()
        sizes.append(len(asked))
        (snapshot,) = learner.taken
        learner.taken.clear()
        assert isinstance(snapshot, Snapshot)
        assert (snapshot.learner_epoch, snapshot.policy_version, snapshot.program) == (5, version, "p")
        np.testing.assert_array_equal(snapshot.weights["w"], float32(bfloat16(learner.weights))["w"])
    assert sizes[0] > 4 > 1 <= sizes[1]
    assert sizes[1] < sizes[0] / 2
    assert [request.held_version for request in asked] == [2] * len(asked)


def test_a_few_parts_are_asked_for_at_once_and_no_more(ends: tuple[Learner, Link]) -> None:
    learner, link = ends
    link.want()
    link.want()  # one fetch at a time
    assert learner.requests.qsize() == 1
    for _ in range(3):
        learner.answer(1)
        assert learner.requests.qsize() == compact_snapshots._AT_ONCE


def test_a_fetch_goes_on_while_the_actor_plays(ends: tuple[Learner, Link]) -> None:
    learner, link = ends
    link.want()
    assert len(learner.answer(taking=False)) > compact_snapshots._AT_ONCE
    rested(link)
    link.want()  # not before this one was taken: the next is a difference to it
    assert learner.requests.empty()
    assert isinstance(link.take(), Snapshot)
    assert link.take() is None


def test_the_link_rests_for_as_long_as_it_worked(ends: tuple[Learner, Link], monkeypatch: pytest.MonkeyPatch) -> None:
    learner, link = ends
    now = 100.0
    monkeypatch.setattr(compact_snapshots.time, "monotonic", lambda: now)
    link.want()
    now = 107.0
    learner.answer()
    assert len(learner.taken) == 1
    for now, asks in ((113.9, 0), (114.1, 1)):  # noqa: B007 - the clock reads it
        link.want()
        assert learner.requests.qsize() == asks


def test_a_lost_part_begins_it_anew_and_its_late_answers_count_for_nothing(ends: tuple[Learner, Link]) -> None:
    learner, link = ends
    link.want()
    learner.answer(1)
    lost = learner.requests.get()
    late = [learner.requests.get() for _ in range(learner.requests.qsize())]
    del lost  # forgotten by who served it: no answer
    assert link.take() is None
    for request in late:
        request.reply(b"junk")
    rested(link)
    link.want()
    learner.answer()
    assert len(learner.taken) == 1


def only_part(data: bytes, parts: int = 1) -> bytes:
    content = np.frombuffer(data, np.uint8)
    return encode(SnapshotPart(learner_epoch=5, policy_version=1, part=0, parts=parts, data=content))


@pytest.mark.parametrize(
    "answer",
    [b"junk", only_part(b"x", 2**40), only_part(b"x"), only_part(encode(RunEnded(learner_epoch=5, reason="")))],
    ids=["junk", "too many parts", "a part of nothing", "a part of something else"],
)
def test_nonsense_is_given_up_and_asked_for_anew(ends: tuple[Learner, Link], answer: bytes) -> None:
    learner, link = ends
    link.want()
    learner.requests.get().reply(answer)
    assert link.take() is None
    rested(link)
    link.want()
    learner.answer()
    assert len(learner.taken) == 1


def test_a_farewell_is_passed_on(ends: tuple[Learner, Link]) -> None:
    learner, link = ends
    link.want()
    learner.requests.get(timeout=LIMIT).reply(encode(RunEnded(learner_epoch=5, reason="over")))
    assert link.take() == RunEnded(learner_epoch=5, reason="over")
