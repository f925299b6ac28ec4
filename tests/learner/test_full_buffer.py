"""learner/serving/rollout_intake.py while the buffer is full: every request gets its answer in time."""

import queue
from collections.abc import Iterator

import pytest
from building import identity, joined_fleet, make_rollout, run_context, run_spec
from processes import LIMIT, until

from daedalus.learner.serving import rollout_intake
from daedalus.learner.serving.rollout_intake import RolloutIntake
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS
from daedalus.protocol.messages import Acknowledgement
from daedalus.protocol.uploads import Upload

HELD = 2  # rollouts of a batch, which is the capacity of the buffer


class Sent:
    """Request with a rollout of actor a."""

    key = "rollouts/a"

    def __init__(self, sequence: int, answers: "queue.SimpleQueue[tuple[int, str]]") -> None:
        self.payload = encode(make_rollout(identity("a", sequence)))
        self.size = len(self.payload)
        self._sequence, self._answers = sequence, answers

    def reply(self, payload: bytes) -> None:
        message = decode(payload, ACKNOWLEDGEMENT_LIMITS)
        assert isinstance(message, Acknowledgement)
        self._answers.put((self._sequence, message.verdict))


class Intake:
    """Open intake, and the answers that it gives."""

    def __init__(self) -> None:
        spec = run_spec(algorithm="impala", batch_rollouts=HELD, max_policy_lag=100)
        context = run_context(spec, fleet=joined_fleet("a"))
        self.counters, self.lock = context.counters, context.lock
        self.rollouts = RolloutIntake(context, lambda: 0)
        self._answers: queue.SimpleQueue[tuple[int, str]] = queue.SimpleQueue()
        self.rollouts.open()

    def offer(self, *sequences: int) -> None:
        for sequence in sequences:
            self.rollouts.offer(Sent(sequence, self._answers))

    def answers(self, number: int) -> list[tuple[int, str]]:
        return [self._answers.get(timeout=LIMIT) for _ in range(number)]

    def batch(self) -> list[int]:
        """Take a batch, as the learner does: it computes from now on."""
        taken: list[Upload] = []

        def is_taken() -> bool:
            taken.extend(self.rollouts.take_batch(0))
            return bool(taken)

        until(is_taken)
        return [each.identity.sequence for each in taken]


@pytest.fixture
def intake() -> Iterator[Intake]:
    opened = Intake()
    yield opened
    with opened.lock:
        opened.rollouts.end(finished=False)
    opened.rollouts.close()


def test_no_answer_is_late_while_the_learner_computes_a_long_batch(
    intake: Intake, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout_intake, "_MOST_SECONDS", 0.3)
    monkeypatch.setattr(rollout_intake, "LATE_SECONDS", 0.3)
    intake.offer(0, 1)
    assert intake.answers(2) == [(0, "accepted"), (1, "accepted")]
    assert intake.batch() == [0, 1]
    intake.offer(2, 3, 4, 5)  # two fill the buffer, one waits for room, one is not judged
    assert sorted(intake.answers(4)) == [(2, "accepted"), (3, "accepted"), (4, "busy"), (5, "busy")]
    assert intake.counters.rollouts_accepted == 4
    monkeypatch.undo()
    intake.offer(4, 5)
    assert [intake.batch(), intake.batch()] == [[2, 3], [4, 5]]
    assert intake.answers(2) == [(4, "accepted"), (5, "accepted")]
    assert not intake.counters.rollouts_rejected


def test_rollouts_that_wait_for_room_keep_their_order_and_their_senders_wait(intake: Intake) -> None:
    intake.offer(0, 1, 2, 3, 4)
    assert intake.answers(2) == [(0, "accepted"), (1, "accepted")]
    assert intake.batch() == [0, 1]
    assert intake.batch() == [2, 3]
    assert intake.answers(2) == [(2, "accepted"), (3, "accepted")]
    assert intake.rollouts.take_batch(0) == []
    assert intake.answers(1) == [(4, "accepted")]
    assert intake.counters.rollouts_accepted == 5
