"""CompactSnapshotFetcher over the memory transport, against the learner's answers."""

import queue

import numpy as np
import pytest
from processes import LIMIT

from daedalus.actor.session import compact_snapshot_fetcher
from daedalus.actor.session.compact_snapshot_fetcher import CompactSnapshotFetcher
from daedalus.learner.serving.snapshot_publisher import CompactSnapshotCache
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import bfloat16, float32
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Message, RunEnded, Snapshot, SnapshotPart, SnapshotRequest
from daedalus.transport.interface import Request
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

FIRST = {"w": np.random.default_rng(1).normal(size=(500, 800)).astype(np.float32)}


class Learner:
    """A learner whose requests are answered when the test says so."""

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
        """Answer all requests, and those that follow from the answers; `taking`: the actor takes what is complete."""
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
                self.fetcher.take_into(self.taken)
        return asked

    fetcher: "Fetcher"
    taken: list[Message]


class Fetcher(CompactSnapshotFetcher):
    def take_into(self, taken: list[Message]) -> None:
        message = self.take()
        if message is not None:
            taken.append(message)


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> tuple[Learner, Fetcher]:
    monkeypatch.setattr(compact_snapshot_fetcher, "_RETRY_SECONDS", 0.0)
    network = MemoryNetwork()
    learner = Learner(network)
    learner.fetcher, learner.taken = Fetcher(MemoryTransport(network), "r", "a", lambda: None), []
    return learner, learner.fetcher


def end_rest(fetcher: CompactSnapshotFetcher) -> None:
    fetcher._next_at = 0.0


def test_first_snapshot_is_whole_and_the_next_is_a_difference(ends: tuple[Learner, Fetcher]) -> None:
    learner, fetcher = ends
    sizes = []
    for version in (1, 2, 7):
        learner.version = version
        end_rest(fetcher)
        fetcher.request_newest()
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


def test_requests_in_parallel_are_limited(ends: tuple[Learner, Fetcher]) -> None:
    learner, fetcher = ends
    fetcher.request_newest()
    fetcher.request_newest()  # one fetch at a time
    assert learner.requests.qsize() == 1
    for _ in range(3):
        learner.answer(1)
        assert learner.requests.qsize() == compact_snapshot_fetcher._PARALLEL_PARTS


def test_fetch_continues_while_the_actor_collects(ends: tuple[Learner, Fetcher]) -> None:
    learner, fetcher = ends
    fetcher.request_newest()
    assert len(learner.answer(taking=False)) > compact_snapshot_fetcher._PARALLEL_PARTS
    end_rest(fetcher)
    fetcher.request_newest()  # not before this snapshot was taken: the next is a difference to it
    assert learner.requests.empty()
    assert isinstance(fetcher.take(), Snapshot)
    assert fetcher.take() is None


def test_link_rests_for_as_long_as_the_fetch_took(
    ends: tuple[Learner, Fetcher], monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, fetcher = ends
    now = 100.0
    monkeypatch.setattr(compact_snapshot_fetcher.time, "monotonic", lambda: now)
    fetcher.request_newest()
    now = 107.0
    learner.answer()
    assert len(learner.taken) == 1
    for now, asks in ((113.9, 0), (114.1, 1)):  # noqa: B007 - the clock reads it
        fetcher.request_newest()
        assert learner.requests.qsize() == asks


def test_lost_part_restarts_the_fetch_and_late_answers_are_ignored(ends: tuple[Learner, Fetcher]) -> None:
    learner, fetcher = ends
    fetcher.request_newest()
    learner.answer(1)
    lost = learner.requests.get()
    late = [learner.requests.get() for _ in range(learner.requests.qsize())]
    del lost  # dropped without an answer
    assert fetcher.take() is None
    for request in late:
        request.reply(b"junk")
    end_rest(fetcher)
    fetcher.request_newest()
    learner.answer()
    assert len(learner.taken) == 1


def only_part(data: bytes, parts: int = 1) -> bytes:
    content = np.frombuffer(data, np.uint8)
    return encode(SnapshotPart(learner_epoch=5, policy_version=1, part=0, parts=parts, data=content))


@pytest.mark.parametrize(
    "answer",
    [
        b"junk",
        only_part(b"x", 2**40),
        only_part(b"x"),
        only_part(encode(RunEnded(learner_epoch=5, outcome="finished", reason=""))),
    ],
    ids=["junk", "too many parts", "a part of nothing", "a part of something else"],
)
def test_invalid_answer_ends_the_fetch_and_the_next_succeeds(ends: tuple[Learner, Fetcher], answer: bytes) -> None:
    learner, fetcher = ends
    fetcher.request_newest()
    learner.requests.get().reply(answer)
    assert fetcher.take() is None
    end_rest(fetcher)
    fetcher.request_newest()
    learner.answer()
    assert len(learner.taken) == 1


def part(number: int, size: int) -> bytes:
    content = np.zeros(size, np.uint8)
    return encode(SnapshotPart(learner_epoch=5, policy_version=1, part=number, parts=100, data=content))


def test_parts_are_together_no_larger_than_a_snapshot(
    ends: tuple[Learner, Fetcher], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compact_snapshot_fetcher, "LEARNER_LIMITS", Limits(max_bytes=10_000, max_header_bytes=0))
    learner, fetcher = ends
    fetcher.request_newest()
    for number in range(2):
        learner.requests.get().reply(part(number, 4_000))
        assert fetcher.in_progress
    learner.requests.get().reply(part(2, 4_000))
    assert not fetcher.in_progress
    assert fetcher.take() is None


def test_part_that_comes_twice_ends_the_fetch(ends: tuple[Learner, Fetcher]) -> None:
    learner, fetcher = ends
    fetcher.request_newest()
    for _ in range(2):
        assert fetcher.in_progress
        learner.requests.get().reply(part(0, 10))
    assert not fetcher.in_progress


def test_run_ended_is_passed_on(ends: tuple[Learner, Fetcher]) -> None:
    learner, fetcher = ends
    fetcher.request_newest()
    learner.requests.get(timeout=LIMIT).reply(encode(RunEnded(learner_epoch=5, outcome="finished", reason="over")))
    assert fetcher.take() == RunEnded(learner_epoch=5, outcome="finished", reason="over")
