"""CompactSnapshotFetcher against the learner's answers, in the time that the test says, and FetchSchedule."""

from collections import deque

import numpy as np
import pytest

from daedalus.actor.session import snapshots
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import Conversation, Query, Work
from daedalus.actor.session.snapshots import CompactSnapshotFetcher, FetchSchedule
from daedalus.learner.serving.snapshot_publisher import CompactSnapshotCache
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import bfloat16, float32
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Message, RunEnded, Snapshot, SnapshotPart, SnapshotRequest

FIRST = {"w": np.random.default_rng(1).normal(size=(500, 800)).astype(np.float32)}


class Ends:
    """A fetcher, and a learner that answers when the test says so."""

    def __init__(self) -> None:
        self.conversation = Conversation(ActorConfig(name="a", incarnation=1))
        self.conversation.run, self.conversation.now = "r", 100.0
        self.fetcher = CompactSnapshotFetcher(self.conversation)
        self.cache = CompactSnapshotCache(5)
        self.version = 1
        self.taken: list[Message] = []
        self._requests: deque[Query] = deque()

    @property
    def weights(self) -> dict[str, np.ndarray]:
        return {name: array * np.float32(1 + 1e-3 * self.version) for name, array in FIRST.items()}

    @property
    def requests(self) -> deque[Query]:
        """Queries without an answer."""
        for action in self.conversation.take_actions():
            assert isinstance(action, Query)
            assert action.key == keys.snapshots("r")
            self._requests.append(action)
        return self._requests

    def reply(self, data: bytes | None) -> None:
        """Answer the oldest query."""
        self.requests.popleft().on_answer(data, self.conversation.now)

    def answer(self, count: int | None = None, *, taking: bool = True) -> list[SnapshotRequest]:
        """Answer all requests, and those that follow from the answers; `taking`: the actor takes what is complete."""
        asked = []
        while self.requests and (count is None or len(asked) < count):
            message = decode(self.requests[0].payload, Limits())
            assert isinstance(message, SnapshotRequest)
            asked.append(message)
            newest = Snapshot(learner_epoch=5, policy_version=self.version, program="p", weights=self.weights)
            self.reply(self.cache.answer(message, encode(newest)))
            if taking and (taken := self.take()) is not None:
                self.taken.append(taken)
        return asked

    def take(self) -> Message | None:
        """Return what the fetcher has, after its work."""
        steps, came = self.fetcher.take(), None
        while True:
            try:
                work = steps.send(came)
            except StopIteration as end:
                return end.value
            assert isinstance(work, Work)
            came = work.call()

    def rest(self, seconds: float = 10.0) -> None:
        """Let time pass."""
        self.conversation.now += seconds


@pytest.fixture
def ends() -> Ends:
    return Ends()


def test_first_snapshot_is_whole_and_the_next_is_a_difference(ends: Ends) -> None:
    sizes = []
    for version in (1, 2, 7):
        ends.version = version
        ends.rest()
        ends.fetcher.request_newest()
        asked = ends.answer()
        sizes.append(len(asked))
        (snapshot,) = ends.taken
        ends.taken.clear()
        assert isinstance(snapshot, Snapshot)
        assert (snapshot.learner_epoch, snapshot.policy_version, snapshot.program) == (5, version, "p")
        np.testing.assert_array_equal(snapshot.weights["w"], float32(bfloat16(ends.weights))["w"])
    assert sizes[0] > 4 > 1 <= sizes[1]
    assert sizes[1] < sizes[0] / 2
    assert [request.held_version for request in asked] == [2] * len(asked)


def test_requests_in_parallel_are_limited(ends: Ends) -> None:
    ends.fetcher.request_newest()
    ends.fetcher.request_newest()  # one fetch at a time
    assert len(ends.requests) == 1
    for _ in range(3):
        ends.answer(1)
        assert len(ends.requests) == snapshots._PARALLEL_PARTS


def test_fetch_continues_while_the_actor_collects(ends: Ends) -> None:
    ends.fetcher.request_newest()
    assert len(ends.answer(taking=False)) > snapshots._PARALLEL_PARTS
    ends.rest()
    ends.fetcher.request_newest()  # not before this snapshot was taken: the next is a difference to it
    assert not ends.requests
    assert isinstance(ends.take(), Snapshot)
    assert ends.take() is None


def test_link_rests_for_as_long_as_the_fetch_took(ends: Ends) -> None:
    ends.fetcher.request_newest()
    ends.rest(7.0)
    ends.answer()
    assert len(ends.taken) == 1
    for seconds, asks in ((6.9, 0), (0.2, 1)):
        ends.rest(seconds)
        ends.fetcher.request_newest()
        assert len(ends.requests) == asks


def test_lost_part_restarts_the_fetch_and_late_answers_are_ignored(ends: Ends) -> None:
    ends.fetcher.request_newest()
    ends.answer(1)
    ends.reply(None)
    assert ends.take() is None
    while ends.requests:
        ends.reply(b"junk")
    ends.rest()
    ends.fetcher.request_newest()
    ends.answer()
    assert len(ends.taken) == 1


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
def test_invalid_answer_ends_the_fetch_and_the_next_succeeds(ends: Ends, answer: bytes) -> None:
    ends.fetcher.request_newest()
    ends.reply(answer)
    assert ends.take() is None
    ends.rest()
    ends.fetcher.request_newest()
    ends.answer()
    assert len(ends.taken) == 1


def part(number: int, size: int) -> bytes:
    content = np.zeros(size, np.uint8)
    return encode(SnapshotPart(learner_epoch=5, policy_version=1, part=number, parts=100, data=content))


def test_parts_are_together_no_larger_than_a_snapshot(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshots, "LEARNER_LIMITS", Limits(max_bytes=10_000, max_header_bytes=0))
    ends.fetcher.request_newest()
    for number in range(2):
        ends.reply(part(number, 4_000))
        assert ends.fetcher.in_progress
    ends.reply(part(2, 4_000))
    assert not ends.fetcher.in_progress
    assert ends.take() is None


def test_part_that_comes_twice_ends_the_fetch(ends: Ends) -> None:
    ends.fetcher.request_newest()
    for _ in range(2):
        assert ends.fetcher.in_progress
        ends.reply(part(0, 10))
    assert not ends.fetcher.in_progress


def test_run_ended_is_passed_on(ends: Ends) -> None:
    ends.fetcher.request_newest()
    ends.reply(encode(RunEnded(learner_epoch=5, outcome="finished", reason="over")))
    assert ends.take() == RunEnded(learner_epoch=5, outcome="finished", reason="over")


def played(schedule: FetchSchedule, *, start: float, seconds: float, row: float, fetch: float = 0.0) -> list[float]:
    """Play a rollout whose rows take `row` seconds; return the times, since its start, at which a fetch was due."""
    schedule.begin_rollout(start, fetch)
    due = [index * row for index in range(round(seconds / row)) if schedule.is_due(start + index * row)]
    schedule.end_rollout(start + seconds)
    return due


def test_fetch_is_due_once_shortly_before_the_end_of_a_rollout() -> None:
    schedule = FetchSchedule()
    assert played(schedule, start=0.0, seconds=0.8, row=0.01) == []
    for start in (1.0, 2.0, 3.0):
        (at,) = played(schedule, start=start, seconds=0.8, row=0.01, fetch=0.05)
    assert at == pytest.approx(0.8 - (0.05 + 0.01), abs=0.011)


def test_fetch_is_due_from_the_start_if_fetches_take_as_long_as_rollouts() -> None:
    schedule = FetchSchedule()
    played(schedule, start=0.0, seconds=0.8, row=0.01)
    assert played(schedule, start=1.0, seconds=0.8, row=0.01, fetch=0.9) == [0.0]


def test_fetch_is_due_again_ever_more_rarely_in_a_rollout_that_takes_long() -> None:
    schedule = FetchSchedule()
    due = played(schedule, start=0.0, seconds=100.0, row=0.25)
    assert due == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0]


def test_snapshot_is_stale_if_it_was_requested_long_before_the_rollout_begins() -> None:
    schedule = FetchSchedule()
    for start in (0.0, 1.0):
        played(schedule, start=start, seconds=1.0, row=0.01, fetch=0.04)
    assert not schedule.is_stale(2.0, requested_at=1.86)
    assert schedule.is_stale(2.0, requested_at=1.84)


@pytest.mark.parametrize(("fetch", "patience"), [(0.0, 0.1), (0.06, 0.12), (0.5, 0.25)])
def test_patience_grows_with_the_duration_of_fetches_up_to_a_quarter_of_a_rollout(
    fetch: float, patience: float
) -> None:
    schedule = FetchSchedule()
    played(schedule, start=0.0, seconds=1.0, row=0.01)
    schedule.begin_rollout(1.0, fetch)
    assert schedule.patience == pytest.approx(patience)
