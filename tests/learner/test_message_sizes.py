"""The learner refuses messages that are too large by their size alone, and copies none of them."""

from collections.abc import Iterator

import pytest
from building import ENVIRONMENTS, SPACES, run_context, run_spec

from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.rollout_intake import largest_request
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import EVALUATION_LIMITS, Limits
from daedalus.protocol.messages import Acknowledgement, Join, Message, Refusal, RunStatus
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

MIB = 1 << 20


class UnreadRequest:
    """Request whose payload must not be read."""

    def __init__(self, key: str, size: int) -> None:
        self.key, self.size = key, size
        self.answers: list[Message] = []

    @property
    def payload(self) -> bytes:
        raise AssertionError("the payload was copied")

    def reply(self, payload: bytes) -> None:
        self.answers.append(decode(payload, Limits()))


def no_status() -> RunStatus:
    raise AssertionError("the status was not queried")


@pytest.fixture
def transport() -> MemoryTransport:
    return MemoryTransport(MemoryNetwork())


@pytest.fixture
def server(transport: MemoryTransport) -> Iterator[ActorServer]:
    service = run_spec().service.model_copy(update={"queue_megabytes": 0.07})
    collection = run_spec().collection.model_copy(update={"envs_per_actor": 500})
    spec = run_spec().model_copy(update={"service": service, "collection": collection})
    opened = ActorServer(run_context(spec), transport, no_status)
    opened.open()
    yield opened
    opened.close("the test is over")


def ask(transport: MemoryTransport, served: str, request: UnreadRequest) -> Message:
    transport._served[served](request)
    (answer,) = request.answers
    return answer


@pytest.mark.parametrize(
    "key", [keys.join("r", "a"), keys.snapshots("r"), keys.evaluations("r", "e"), keys.status("r")]
)
def test_oversized_query_is_refused_unread(server: ActorServer, transport: MemoryTransport, key: str) -> None:
    served = {"join": keys.join("r", "*"), "evaluations": keys.evaluations("r", "*")}.get(key.split("/")[2], key)
    answer = ask(transport, served, UnreadRequest(key, 400 * MIB))
    assert isinstance(answer, Refusal)
    assert answer.code == "malformed"
    assert answer.reason.startswith("the message has 419,430,400 bytes, more than ")


def send_rollout(transport: MemoryTransport, size: int) -> Acknowledgement:
    answer = ask(transport, keys.rollouts("r", "*"), UnreadRequest(keys.rollouts("r", "a"), size))
    assert isinstance(answer, Acknowledgement)
    return answer


def test_oversized_rollout_of_an_unknown_sender_is_fenced_unread(
    server: ActorServer, transport: MemoryTransport
) -> None:
    answer = send_rollout(transport, 400 * MIB)
    assert (answer.verdict, answer.reason) == ("fenced", "actor 'a' has not joined")


def test_rollout_above_the_size_of_the_run_is_rejected_unread(server: ActorServer, transport: MemoryTransport) -> None:
    join = Join(actor="a", incarnation=1, spaces=SPACES, environments=ENVIRONMENTS)
    transport.query(keys.join("r", "a"), encode(join), timeout=1.0)
    answer = send_rollout(transport, 400 * MIB)
    assert answer.verdict == "rejected"
    assert answer.reason.startswith("the message has 419,430,400 bytes, and a rollout of this actor at most ")
    assert server.context.fleet.actors["a"].rejected == {"malformed": 1}


def test_rollout_above_the_queue_is_rejected_with_the_setting_to_raise(
    server: ActorServer, transport: MemoryTransport
) -> None:
    """It fits the specification, but never the queue: after three, the actor is quarantined with this reason."""
    join = Join(actor="a", incarnation=1, spaces=SPACES, environments=4000)
    transport.query(keys.join("r", "a"), encode(join), timeout=1.0)
    answers = [send_rollout(transport, 75_000) for _ in range(3)]
    assert [answer.verdict for answer in answers] == ["rejected", "rejected", "quarantined"]
    assert "service.queue_megabytes allows 73,400: raise that setting" in answers[0].reason


@pytest.mark.parametrize(("queue_megabytes", "largest"), [(64.0, 64 * MIB), (0.001, EVALUATION_LIMITS.max_bytes)])
def test_learner_receives_no_query_above_its_queue(queue_megabytes: float, largest: int) -> None:
    """Nor above an evaluation, which does not depend on the queue. The header is not counted here."""
    spec = run_spec()
    service = spec.service.model_copy(update={"queue_megabytes": queue_megabytes})
    assert 0 < largest_request(spec.model_copy(update={"service": service})) - largest < 512 << 10
