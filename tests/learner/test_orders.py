"""Orders of an operator, and the metrics that an operator reads, over the memory transport."""

import re
from pathlib import Path

import pytest
from processes import LIMIT, until
from session_fleet import GatedActor, LearnerProcess

from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import METRICS_LIMITS, Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    EventsRequest,
    Message,
    MetricsReport,
    MetricsRequest,
    OrderRequest,
    Refusal,
)
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class Operator:
    """An operator of the run in the folder `run`."""

    def __init__(self, network: MemoryNetwork) -> None:
        self._transport = MemoryTransport(network)

    def ask(self, key: str, message: Message, limits: Limits) -> Message:
        answers: list[bytes] = []
        until(lambda: answers.extend(self._transport.query(key, encode(message), timeout=LIMIT)) or answers)
        return decode(answers[0], limits)

    def order(self, message: Message) -> Message:
        return self.ask(keys.orders("run"), message, Limits())

    def metrics(self, first: int = 0) -> MetricsReport:
        report = self.ask(keys.status("run"), MetricsRequest(first=first), METRICS_LIMITS)
        assert isinstance(report, MetricsReport)
        return report


def steps(report: MetricsReport) -> list[float]:
    columns = report.page.columns
    return report.values[:, columns.index("env_steps")].tolist() if columns else []


@pytest.fixture
def network() -> MemoryNetwork:
    return MemoryNetwork()


def test_operator_orders_a_checkpoint_then_the_end(network: MemoryNetwork, tmp_path: Path) -> None:
    learner, operator = LearnerProcess(network, tmp_path / "run"), Operator(network)
    actor = GatedActor(network, "actor")
    actor.open_gate()
    until(lambda: steps(operator.metrics()))
    assert checkpoints(tmp_path / "run") == []
    answer = operator.order(OrderRequest(order="checkpoint"))
    assert isinstance(answer, Acknowledgement)
    assert re.fullmatch(r"checkpoint saved at [\d,]+ env_steps", answer.reason)
    assert checkpoints(tmp_path / "run")  # it is there when the answer says so
    assert not learner.ended
    assert operator.order(OrderRequest(order="stop")) == Acknowledgement(verdict="accepted")
    outcome = learner.join()
    assert (outcome.ordered, outcome.finished, outcome.saved) == (True, False, True)
    actor.stop.set()
    actor.join()


def test_operator_stops_a_learner_without_actors(network: MemoryNetwork, tmp_path: Path) -> None:
    learner, operator = LearnerProcess(network, tmp_path / "run"), Operator(network)
    operator.order(OrderRequest(order="stop"))
    assert learner.join().ordered


def test_other_messages_are_no_orders(network: MemoryNetwork, tmp_path: Path) -> None:
    learner, operator = LearnerProcess(network, tmp_path / "run"), Operator(network)
    refusal = operator.order(EventsRequest())
    assert isinstance(refusal, Refusal)
    assert refusal.code == "malformed"
    learner.stop.set()
    assert not learner.join().ordered


def test_a_resumed_learner_knows_the_metrics_of_the_whole_run(network: MemoryNetwork, tmp_path: Path) -> None:
    first, operator = LearnerProcess(network, tmp_path / "run"), Operator(network)
    actor = GatedActor(network, "actor")
    actor.open_gate()
    until(lambda: steps(operator.metrics()))
    operator.order(OrderRequest(order="stop"))
    first.join()
    lines = ["env_steps,entropy", "1,0.5", "2,0.25", "999999999,0.125"]  # the last is later than the checkpoint
    (tmp_path / "run" / "metrics.csv").write_text("\n".join(lines))
    second = LearnerProcess(network, tmp_path / "run", resume=True)
    until(lambda: len(steps(operator.metrics())) > 2)
    found = steps(operator.metrics())
    assert found[:2] == [1, 2]
    assert found == sorted(found)
    assert found[-1] < 999999999
    second.stop.set()
    actor.stop.set()
    second.join()
    actor.join()
