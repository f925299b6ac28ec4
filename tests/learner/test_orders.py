"""Orders of an operator, and the metrics that an operator reads, over the memory transport."""

import re
from pathlib import Path

from processes import LIMIT, until
from session_fleet import GatedActor, LearnerProcess, order_to

from daedalus.learner.run.run_directory import read_json
from daedalus.learner.serving.events import read_events
from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import METRICS_LIMITS, Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    EventsReport,
    EventsRequest,
    Message,
    MetricsReport,
    MetricsRequest,
    Refusal,
    RunStatus,
    StatusReport,
)
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class Operator:
    """An operator of the run in the folder `run`."""

    def __init__(self, network: MemoryNetwork) -> None:
        self._transport = MemoryTransport(network)

    def ask(self, message: Message | None, limits: Limits) -> Message:
        answers: list[bytes] = []
        payload = b"" if message is None else encode(message)
        until(lambda: answers.extend(self._transport.query(keys.status("run"), payload, timeout=LIMIT)) or answers)
        return decode(answers[0], limits)

    def metrics(self, first: int = 0) -> MetricsReport:
        report = self.ask(MetricsRequest(first=first), METRICS_LIMITS)
        assert isinstance(report, MetricsReport)
        return report

    def status(self) -> RunStatus:
        report = self.ask(None, Limits())
        assert isinstance(report, StatusReport)
        return report.status

    def events(self) -> list[tuple[str, str, str]]:
        report = self.ask(EventsRequest(), Limits())
        assert isinstance(report, EventsReport)
        return [(event.kind, event.actor, event.text) for event in report.page.events]


def steps(report: MetricsReport) -> list[float]:
    columns = report.page.columns
    return report.values[:, columns.index("env_steps")].tolist() if columns else []


def test_operator_orders_a_checkpoint_then_the_end(network: MemoryNetwork, tmp_path: Path) -> None:
    learner, operator = LearnerProcess(network, tmp_path / "run"), Operator(network)
    actor = GatedActor(network, "actor")
    actor.open_gate()
    until(lambda: steps(operator.metrics()))
    assert checkpoints(tmp_path / "run") == []
    answer = order_to(network, "checkpoint")
    assert isinstance(answer, Acknowledgement)
    assert re.fullmatch(r"checkpoint saved at [\d,]+ env_steps", answer.reason)
    assert checkpoints(tmp_path / "run")  # it is there when the answer says so
    assert not learner.ended
    assert ("checkpoint", "", "ordered by operator alice at laptop") in operator.events()
    assert re.fullmatch(r"\S+Z: save a checkpoint, by operator alice at laptop", operator.status().last_order)
    stopped = order_to(network, "stop", operator=keys.NO_OPERATOR, token="operator bob", host="box")
    assert isinstance(stopped, Acknowledgement)
    assert stopped.reason.startswith("checkpoint saved at ")
    outcome, author = learner.join(), "the token of operator bob, on the page of the gateway at box"
    assert (outcome.stopped_by, outcome.finished, outcome.saved) == (author, False, True)
    assert read_json(tmp_path / "run" / "summary.json")["stopped_by"] == author
    recorded = [event.text for event in read_events(tmp_path / "run")]
    assert recorded.count(f"stopped by {author}") == recorded.count("ordered by operator alice at laptop") == 1
    actor.stop.set()
    actor.join()


def test_operator_stops_a_learner_without_actors(network: MemoryNetwork, tmp_path: Path) -> None:
    learner = LearnerProcess(network, tmp_path / "run")
    order_to(network, "stop", operator=keys.NO_OPERATOR)
    author = "the operator at laptop, without an operator's certificate"
    assert learner.join().stopped_by == author
    assert f"stopped by {author}" in [event.text for event in read_events(tmp_path / "run")]


def test_an_order_that_came_before_or_is_for_another_process_is_refused(network: MemoryNetwork, tmp_path: Path) -> None:
    learner, operator = LearnerProcess(network, tmp_path / "run"), Operator(network)
    order_to(network, "drain", "nobody", number=7)
    wrong = {
        "this order came before: an order is carried out once": {"number": 7},
        "the order is for run 'other', and this is run 'run'": {"run": "other"},
        "the order is for run '', and this is run 'run'": {"run": ""},  # of a sender that names none
        "the order is for another learner process of this run": {"learner_epoch": 1},
        "the key of an order names one operator": {"operator": "*"},
    }
    for reason, fields in wrong.items():
        refusal = order_to(network, "stop", **fields)
        assert isinstance(refusal, Refusal)
        assert refusal.reason.startswith(reason)
    assert not learner.ended
    assert not operator.status().last_order
    refused = [text for kind, _, text in operator.events() if kind == "refused"]
    assert refused[0].startswith("refused to drain actor nobody as ordered by operator alice at laptop: no actor")
    learner.stop.set()
    assert not learner.join().stopped_by


def test_other_messages_are_no_orders(network: MemoryNetwork, tmp_path: Path) -> None:
    learner, transport = LearnerProcess(network, tmp_path / "run"), MemoryTransport(network)
    answers: list[bytes] = []
    key = keys.orders("run", "alice")
    until(lambda: answers.extend(transport.query(key, encode(EventsRequest()), timeout=LIMIT)) or answers)
    refusal = decode(answers[0], Limits())
    assert isinstance(refusal, Refusal)
    assert refusal.code == "malformed"
    learner.stop.set()
    assert not learner.join().stopped_by


def test_a_resumed_learner_knows_the_metrics_of_the_whole_run(network: MemoryNetwork, tmp_path: Path) -> None:
    first, operator = LearnerProcess(network, tmp_path / "run"), Operator(network)
    actor = GatedActor(network, "actor")
    actor.open_gate()
    until(lambda: steps(operator.metrics()))
    order_to(network, "stop")
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
