"""learner/serving/actor_server.py over the memory transport: rollouts, evaluators, publication."""

import queue
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from building import ENVIRONMENTS, EPOCH, POLICY, RECURRENT, SPACES, identity, make_rollout, run_context, run_spec
from log_lines import LINES
from processes import LIMIT, until

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving import actor_server, rollout_intake
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.training.learner import Learner
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    ActorsPage,
    ActorsReport,
    EvaluationReport,
    EvaluationRequest,
    Join,
    Message,
    Refusal,
    RunEnded,
    RunStatus,
    Snapshot,
    SnapshotRequest,
)
from daedalus.protocol.spec import RunSpec, TrainingSpec
from daedalus.protocol.uploads import Rollout
from daedalus.transport.interface import Request, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

REPORT = EvaluationReport(
    evaluator="e",
    learner_epoch=EPOCH,
    policy_version=0,
    returns=np.ones(3, np.float32),
    lengths=np.ones(3, np.int32),
)


def no_status() -> RunStatus:
    raise AssertionError("the status was not queried")


def open_server(network: MemoryNetwork, spec: RunSpec, counters: RunCounters) -> ActorServer:
    """Return an open server."""
    transport = MemoryTransport(network)
    server = ActorServer(run_context(spec, counters=counters), transport, no_status)
    server.open()
    return server


@pytest.fixture
def server(network: MemoryNetwork) -> Iterator[ActorServer]:
    opened = open_server(network, run_spec(), RunCounters(10))
    yield opened
    opened.close("the test is over")


@pytest.mark.parametrize(("algorithm", "updates"), [("impala", 1), ("appo", 6)])
def test_rollouts_of_the_next_version_are_accepted_as_soon_as_its_batch_is_taken(
    network: MemoryNetwork, algorithm: str, updates: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Actors may play the snapshot of that version before the next batch is complete."""
    monkeypatch.setattr(rollout_intake, "_MOST_SECONDS", 1e6)  # only the next batch releases an answer
    counters = RunCounters(10)
    spec = run_spec(actors=1, algorithm=algorithm, passes=2, minibatches=3)
    server = open_server(network, spec, counters)
    actor = MemoryTransport(network)
    join = Join(actor="a", incarnation=1, spaces=SPACES, environments=ENVIRONMENTS)

    answers: queue.Queue[bytes | None] = queue.Queue()

    def send(sequence: int, version: int) -> None:
        rollout = encode(make_rollout(identity("a", sequence), version=version))
        actor.query_async(keys.rollouts("r", "a"), rollout, timeout=LIMIT, on_answer=answers.put)

    def verdict() -> str:
        acknowledgement = decode(answers.get(timeout=LIMIT) or b"", Limits())
        assert isinstance(acknowledgement, Acknowledgement)
        return acknowledgement.verdict

    try:
        actor.query(keys.join("r", "a"), encode(join), timeout=LIMIT)
        send(0, version=1)
        assert verdict() == "rejected"
        send(1, version=0)
        assert verdict() == "accepted"
        assert len(server.rollouts.take_batch(0)) == 1
        send(2, version=updates + 1)
        assert verdict() == "rejected"
        send(3, version=updates)
        until(lambda: counters.rollouts_accepted == 2)
        assert answers.empty()  # while the learner computes
        assert len(server.rollouts.take_batch(updates)) == 1
        assert verdict() == "accepted"
    finally:
        server.close("the test is over")
    assert (counters.updates, counters.rollouts_trained, counters.policy_lag_sum) == (2 * updates, 2, 0)
    events = server.context.events.report()
    assert [(event.kind, event.count) for event in events] == [
        *(("started", 1), ("joined", 1), ("rejected", 2), ("ended", 1))
    ]
    assert events[2].text.startswith("rollout rejected as unfit: policy version 1 is newer than")
    assert events[3].text == "the test is over"


@pytest.mark.parametrize(("state_size", "updates"), [(0, 3 * 4), (5, 3 * ENVIRONMENTS)])
def test_versions_of_a_batch_are_as_many_as_the_learner_makes_of_it(
    network: MemoryNetwork, state_size: int, updates: int
) -> None:
    """With memory there are at most as many minibatches as environments."""
    counters = RunCounters(10)
    server = open_server(network, run_spec(actors=1, algorithm="appo", passes=3, minibatches=4), counters)
    actor = MemoryTransport(network)
    join = Join(actor="a", incarnation=1, spaces=SPACES, environments=ENVIRONMENTS)
    try:
        server.offer_policy(b"program", state_size)
        actor.query(keys.join("r", "a"), encode(join), timeout=LIMIT)
        rollout = make_rollout(identity("a"), state_size=state_size)
        actor.query(keys.rollouts("r", "a"), encode(rollout), timeout=LIMIT)
        rollouts = server.rollouts.take_batch(0)
        learner = Learner(
            TrainingSpec(algorithm="appo", passes=3, minibatches=4), RECURRENT if state_size else POLICY, SPACES
        )
        learner.step([each for each in rollouts if isinstance(each, Rollout)], 0.0)
        assert counters.updates == learner.policy_version == updates
    finally:
        server.close("the test is over")


def test_rows_that_only_reset_are_not_counted_for_their_actor(network: MemoryNetwork) -> None:
    server = open_server(network, run_spec(actors=1, algorithm="impala"), RunCounters(10))
    actor = MemoryTransport(network)
    join = Join(actor="a", incarnation=1, spaces=SPACES, environments=ENVIRONMENTS)
    try:
        actor.query(keys.join("r", "a"), encode(join), timeout=LIMIT)
        rollout = make_rollout(identity("a"))
        actor.query(keys.rollouts("r", "a"), encode(rollout), timeout=LIMIT)
        server.rollouts.count_trained(server.rollouts.take_batch(0), [])
        assert server.context.fleet.actors["a"].env_steps == np.count_nonzero(rollout.valid) < rollout.valid.size
    finally:
        server.close("the test is over")


class FakeEvaluator:
    """Evaluator that sends without waiting and keeps the answers."""

    def __init__(self, network: MemoryNetwork) -> None:
        self._transport = MemoryTransport(network)
        self.answers: list[Message] = []

    def send(self, payload: bytes, evaluator: str = "e") -> None:
        def on_answer(answer: bytes | None) -> None:
            if answer is not None:  # None: the test took the request without a reply
                self.answers.append(decode(answer, Limits()))

        self._transport.query_async(keys.evaluations("r", evaluator), payload, timeout=1.0, on_answer=on_answer)


@pytest.fixture
def evaluator(network: MemoryNetwork, server: ActorServer) -> FakeEvaluator:
    return FakeEvaluator(network)


def offer_policy(server: ActorServer) -> None:
    server.offer_policy(b"program", 0)
    server.publisher.publish(3, {"w": np.zeros(2, np.float32)})


def codes(evaluator: FakeEvaluator) -> list[str]:
    return [answer.code for answer in evaluator.answers if isinstance(answer, Refusal)]


def test_evaluator_messages_are_queued_until_the_learner_takes_them(
    server: ActorServer, evaluator: FakeEvaluator
) -> None:
    offer_policy(server)
    evaluator.send(encode(EvaluationRequest(evaluator="e")))
    evaluator.send(encode(REPORT))
    assert evaluator.answers == []
    ((first, asked),) = server.evaluations.take_requests()
    ((_, report),) = server.evaluations.take_reports()
    assert asked == EvaluationRequest(evaluator="e")
    assert isinstance(report, EvaluationReport)
    assert server.evaluations.take_requests() == server.evaluations.take_reports() == []
    first.reply(server.publisher.snapshot())
    (answer,) = evaluator.answers
    assert isinstance(answer, Snapshot)
    assert answer.policy_version == 3


@pytest.mark.parametrize("message", [EvaluationRequest(evaluator="e"), REPORT])
def test_newer_message_of_an_evaluator_replaces_the_older_one(
    server: ActorServer, evaluator: FakeEvaluator, message: Message
) -> None:
    """An evaluator that was restarted gets its answer, and one that floods the learner has one message in the queue."""
    offer_policy(server)
    for _ in range(3):
        evaluator.send(encode(message))
    assert codes(evaluator) == ["not_ready"] * 2
    waiting = server.evaluations.take_requests() + server.evaluations.take_reports()
    assert len(waiting) == 1
    waiting[0][0].reply(server.publisher.snapshot())
    assert isinstance(evaluator.answers[-1], Snapshot)


def test_evaluation_request_before_the_first_policy_is_refused_as_not_ready(
    server: ActorServer, evaluator: FakeEvaluator
) -> None:
    evaluator.send(encode(EvaluationRequest(evaluator="e")))
    assert codes(evaluator) == ["not_ready"]
    assert server.evaluations.take_requests() == []


def test_full_evaluation_queue_makes_room_by_dropping_messages_of_the_owner_with_the_most(
    server: ActorServer, evaluator: FakeEvaluator
) -> None:
    offer_policy(server)
    names = ["honest", *(f"greedy.{number}" for number in range(63)), "other", "greedy.63"]
    for name in names:
        evaluator.send(encode(EvaluationRequest(evaluator=name)), name)
    assert codes(evaluator) == ["not_ready"] * 2
    waiting = [message.evaluator for _, message in server.evaluations.take_requests()]
    assert waiting == ["honest", *(f"greedy.{number}" for number in range(2, 63)), "other", "greedy.63"]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xff" * 100,
        encode(RunEnded(learner_epoch=EPOCH, outcome="finished", reason="")),
        encode(EvaluationRequest(evaluator="f")),
        encode(EvaluationRequest(evaluator="")),
    ],
    ids=["empty", "noise", "another message", "another's name", "no name"],
)
def test_invalid_evaluator_message_is_refused_as_malformed(
    server: ActorServer, evaluator: FakeEvaluator, payload: bytes
) -> None:
    offer_policy(server)
    evaluator.send(payload)
    assert codes(evaluator) == ["malformed"]
    assert server.evaluations.take_requests() == server.evaluations.take_reports() == []


def test_oversized_evaluation_report_is_refused_as_malformed(server: ActorServer, evaluator: FakeEvaluator) -> None:
    offer_policy(server)
    many = 200_000
    evaluator.send(
        encode(
            EvaluationReport(
                evaluator="e",
                learner_epoch=EPOCH,
                policy_version=0,
                returns=np.zeros(many, np.float32),
                lengths=np.zeros(many, np.int32),
            )
        )
    )
    assert codes(evaluator) == ["malformed"]


@pytest.mark.parametrize("finished", [True, False])
def test_waiting_and_later_evaluator_messages_are_refused_after_close(
    server: ActorServer, evaluator: FakeEvaluator, finished: bool
) -> None:
    offer_policy(server)
    evaluator.send(encode(EvaluationRequest(evaluator="e")))
    server.close("solved", finished=finished)
    evaluator.send(encode(REPORT))
    assert codes(evaluator) == ["finished" if finished else "not_ready"] * 2


def test_concurrent_evaluation_requests_are_all_queued(server: ActorServer, network: MemoryNetwork) -> None:
    offer_policy(server)
    evaluators = [FakeEvaluator(network) for _ in range(16)]
    threads = [
        threading.Thread(target=evaluator.send, args=(encode(EvaluationRequest(evaluator=f"e{number}")), f"e{number}"))
        for number, evaluator in enumerate(evaluators)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    taken = {message.evaluator for _, message in server.evaluations.take_requests()}
    assert taken == {f"e{number}" for number in range(16)}


class UnreachableTransport(MemoryTransport):
    """Transport that records calls of `reopen`, which always fails."""

    def __init__(self, network: MemoryNetwork) -> None:
        super().__init__(network)
        self.reopened: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def reopen(self, unless_served: str | None = None) -> bool:
        self.reopened.put(unless_served)
        raise TransportError("no router is reachable")


def test_session_is_reopened_when_no_request_arrives(network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daedalus.learner.serving.actor_server._SILENCE_SECONDS", 0.02)
    transport = UnreachableTransport(network)
    server = ActorServer(run_context(), transport, no_status)
    server.open()
    try:
        for _ in range(3):
            assert transport.reopened.get(timeout=LIMIT) == keys.status("r")
    finally:
        server.close("the test is over")


def test_request_resets_the_session_watchdog(network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daedalus.learner.serving.actor_server._SILENCE_SECONDS", 1000.0)
    server = open_server(network, run_spec(), RunCounters(10))
    try:
        before = server._watchdog._heard_at
        MemoryTransport(network).query(keys.snapshots("r"), timeout=LIMIT)
        assert server._watchdog._heard_at > before
    finally:
        server.close("the test is over")


def test_stale_rollouts_are_counted_for_the_run_when_their_actor_was_evicted(network: MemoryNetwork) -> None:
    counters = RunCounters(10)
    server = open_server(network, run_spec(actors=2, max_policy_lag=0), counters)
    actor = MemoryTransport(network)
    try:
        actor.query(
            keys.join("r", "a"),
            encode(Join(actor="a", incarnation=1, spaces=SPACES, environments=ENVIRONMENTS)),
            timeout=LIMIT,
        )
        actor.query(keys.rollouts("r", "a"), encode(make_rollout(identity("a"))), timeout=LIMIT)
        del server.context.fleet.actors["a"]
        assert server.rollouts.take_batch(5) == []
        assert counters.rollouts_rejected == {"stale": 1}
    finally:
        server.close("the test is over")


@pytest.mark.parametrize(
    ("training", "most"),
    [
        ({"algorithm": "impala", "max_policy_lag": 3}, 8),  # four batches of two
        ({"algorithm": "a3c", "max_policy_lag": 7}, 8),  # eight batches of one
        ({"algorithm": "appo", "passes": 2, "minibatches": 2, "max_policy_lag": 13, "batch_rollouts": 3}, 12),
        ({"algorithm": "impala", "max_policy_lag": 0}, 4),  # two for each actor in any case
    ],
)
def test_queue_holds_only_rollouts_that_are_not_stale_at_their_turn(
    network: MemoryNetwork, training: dict[str, Any], most: int
) -> None:
    """The buffer holds a batch, one rollout is being judged, and `most` rollouts are queued behind them."""
    counters = RunCounters(10)
    spec = run_spec(actors=2, **training)
    server = open_server(network, spec, counters)
    actor = MemoryTransport(network)
    answers: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    try:
        join = Join(actor="a", incarnation=1, spaces=SPACES, environments=ENVIRONMENTS)
        actor.query(keys.join("r", "a"), encode(join), timeout=LIMIT)
        held = max(spec.training.batch_rollouts or 2, 2)
        for sequence in range(held + 1):
            payload = encode(make_rollout(identity("a", sequence)))
            actor.query_async(keys.rollouts("r", "a"), payload, timeout=LIMIT, on_answer=answers.put)
        until(lambda: counters.rollouts_accepted == held and server.rollouts.queue_bytes == 0)
        for sequence in range(held + 1, held + most + 3):
            payload = encode(make_rollout(identity("a", sequence)))
            actor.query_async(keys.rollouts("r", "a"), payload, timeout=LIMIT, on_answer=answers.put)
        messages = [decode(answer, Limits()) for _ in range(held + 2) if (answer := answers.get(timeout=LIMIT))]
        verdicts = [message.verdict for message in messages if isinstance(message, Acknowledgement)]
        assert verdicts == ["accepted"] * held + ["busy"] * 2
        assert answers.empty()
        assert server.context.fleet.actors["a"].busy == 2
    finally:
        server.close("the test is over")


# ------------------------------------------------------------------------------------ publication interval


def with_fleet(network: MemoryNetwork, server: ActorServer, count: int) -> MemoryTransport:
    """Add `count` live actors to the fleet."""
    actors = MemoryTransport(network)
    for number in range(count):
        join = Join(actor=f"a{number}", incarnation=1, spaces=SPACES, environments=ENVIRONMENTS)
        actors.query(keys.join("r", f"a{number}"), encode(join), timeout=LIMIT)
        actors.declare_presence(keys.presence("r", f"a{number}", 1))
    return actors


def no_weights() -> dict[str, np.ndarray]:
    return {"w": np.zeros(2, np.float32)}


@pytest.mark.parametrize(
    ("count", "published"),
    [(1, [1, 2, 3, 4, 5, 6]), (4, [1, 2, 3, 4, 5, 6]), (8, [2, 4, 6]), (12, [3, 6]), (40, [])],
)
def test_publication_interval_grows_with_the_fleet(
    network: MemoryNetwork, server: ActorServer, count: int, published: list[int]
) -> None:
    actors = with_fleet(network, server, count)
    news: list[int] = []
    inbox = actors.subscribe(keys.snapshots("r"), lambda: news.append(version_of(inbox.take())))
    for version in range(1, 7):
        server.publisher.publish_if_due(version, lambda: no_weights, rollouts=1)
    assert news == published
    assert server.publisher.version == (published or [0])[-1]


def test_publication_interval_is_at_most_a_quarter_of_the_policy_lag_bound(network: MemoryNetwork) -> None:
    server = open_server(network, run_spec(max_policy_lag=32), RunCounters(10))
    try:
        with_fleet(network, server, 400)
        published = set()
        for version in range(1, 41):
            server.publisher.publish_if_due(version, lambda: no_weights, rollouts=1)
            published.add(server.publisher.version)
        assert published == {0, 8, 16, 24, 32, 40}
    finally:
        server.close("the test is over")


def test_requested_snapshot_is_sent_unless_the_actor_holds_it_and_counts_for_the_actor(
    network: MemoryNetwork, server: ActorServer
) -> None:
    actors = with_fleet(network, server, 1)
    weights = {"w": np.zeros(2, np.float32)}

    def request(held: int | None) -> bytes:
        payload = encode(SnapshotRequest(actor="a0", held_version=held, compact=False))
        return actors.query(keys.snapshots("r"), payload, timeout=LIMIT)[0]

    assert isinstance(decode(request(None), Limits()), Refusal)
    server.publisher.publish(3, weights)
    answers = [request(held) for held in (None, 2, 3)]
    whole = server.publisher.snapshot()
    assert answers[:2] == [whole, whole]
    unchanged = decode(answers[2], Limits())
    assert isinstance(unchanged, Refusal)
    assert unchanged.code == "not_ready"
    actor = server.context.fleet.actors["a0"]
    assert (actor.fetches, actor.compact_snapshots) == (True, False)
    assert actor.answered_bytes > 2 * len(whole)
    server.close("solved", finished=True)
    assert isinstance(decode(request(3), Limits()), RunEnded)


def test_invalid_request_for_a_snapshot_is_refused_as_malformed(network: MemoryNetwork, server: ActorServer) -> None:
    for payload in (b"\xff" * 20, encode(EvaluationRequest(evaluator="e"))):
        (answer,) = MemoryTransport(network).query(keys.snapshots("r"), payload, timeout=LIMIT)
        refusal = decode(answer, Limits())
        assert isinstance(refusal, Refusal)
        assert refusal.code == "malformed"


def test_synchronous_algorithm_publishes_every_version(network: MemoryNetwork) -> None:
    server = open_server(network, run_spec(actors=1, algorithm="a2c"), RunCounters(10))
    try:
        with_fleet(network, server, 40)
        for version in (1, 2):
            server.publisher.publish_if_due(version, lambda: no_weights, rollouts=1)
            assert server.publisher.version == version
    finally:
        server.close("the test is over")


def test_with_a_gpu_versions_that_are_due_while_one_is_copied_are_left_out(network: MemoryNetwork) -> None:
    server = open_server(network, run_spec(device="cuda", algorithm="impala"), RunCounters(10))
    copied, published = threading.Event(), threading.Event()

    def slow() -> dict[str, np.ndarray]:
        assert copied.wait(LIMIT)
        return no_weights()

    try:
        actors = with_fleet(network, server, 1)
        news: list[int] = []

        def receive() -> None:
            news.append(version_of(inbox.take()))
            published.set()

        inbox = actors.subscribe(keys.snapshots("r"), receive)
        for version in (1, 2, 3):
            server.publisher.publish_if_due(version, lambda: slow, rollouts=1)
        assert server.publisher.version == 0
        copied.set()
        assert published.wait(LIMIT)
        server.publisher.publish(4, no_weights())  # waits for the thread
        assert news == [1, 4]
    finally:
        server.close("the test is over")


def test_acknowledgement_contains_the_newest_published_version(network: MemoryNetwork, server: ActorServer) -> None:
    """An actor cannot fetch a version that is not published."""
    offer_policy(server)
    actors = with_fleet(network, server, 40)
    server.publisher.publish_if_due(4, lambda: no_weights, rollouts=1)
    rollout = make_rollout(identity("a0", 0), version=0)
    (answer,) = actors.query(keys.rollouts("r", "a0"), encode(rollout), timeout=LIMIT)
    acknowledgement = decode(answer, Limits())
    assert isinstance(acknowledgement, Acknowledgement)
    assert (acknowledgement.verdict, acknowledgement.policy_version) == ("accepted", 3)


def version_of(data: bytes | None) -> int:
    assert data is not None
    message = decode(data, Limits())
    return message.policy_version if isinstance(message, Snapshot) else -1


@pytest.mark.parametrize("difference", [1, -1])
def test_a_learner_steps_down_for_a_newer_one_of_its_run(
    network: MemoryNetwork, difference: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(actor_server, "_LOOK_SECONDS", 0.02)
    transport, other, actor = MemoryTransport(network), MemoryTransport(network), MemoryTransport(network)
    server = ActorServer(run_context(), transport, no_status)
    stop, orders = server.context.stop, server.orders
    server.open()
    ends = actor.subscribe(keys.run_end("r"), lambda: None)
    page = ActorsPage(learner_epoch=EPOCH + difference, actors=())
    looked = threading.Semaphore(0)

    def answer(request: Request) -> None:
        request.reply(encode(ActorsReport(page=page)))
        looked.release()

    other.serve(keys.status("r"), answer)
    if difference > 0:
        assert stop.wait(LIMIT)
        assert orders.superseded_by == EPOCH + 1
        until(lambda: any("this learner steps down, and the run goes on there" in line for line in LINES))
        ended = decode(ends.take() or b"", Limits())
        assert isinstance(ended, RunEnded)
        assert (ended.outcome, ended.learner_epoch) == ("stopped", EPOCH)
        join = encode(Join(actor="a", incarnation=1))
        refusal = decode(actor.query(keys.join("r", "a"), join, timeout=LIMIT)[0], Limits())
        assert isinstance(refusal, Refusal)
        assert refusal.code == "not_ready"
    else:
        for _ in range(3):
            assert looked.acquire(timeout=LIMIT)
        assert not stop.is_set()
        assert sum("it is older than this one and steps down" in line for line in LINES) == 1
    server.close("the test is over")
