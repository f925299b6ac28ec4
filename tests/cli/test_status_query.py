"""transport/status_query.py against the server of a learner: fleets of any size."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from building import EPOCH, SPACES, run_context
from prometheus_client import CollectorRegistry, generate_latest
from statuses import actor_status, run_status

from daedalus.cli.commands.status import status as status_command
from daedalus.gateway.watching.learner_source import LearnerSource
from daedalus.launch.prometheus_exporter import StatusCollector
from daedalus.learner.reporting.run_reporter import RunReporter
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run import heartbeat
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.run_context import Health
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import STATUS_LIMITS, STATUS_REQUEST_LIMITS
from daedalus.protocol.messages import (
    MAX_EVENTS,
    PAGE_ACTORS,
    Acknowledgement,
    ActorsPage,
    ActorsReport,
    ActorsRequest,
    ActorStatus,
    Event,
    EventsPage,
    EventsReport,
    Join,
    Message,
    Origin,
    Refusal,
    RefusedJoin,
    StatusReport,
)
from daedalus.protocol.spaces import DiscreteSpace
from daedalus.transport.memory import MemoryNetwork, MemoryTransport
from daedalus.transport.status_query import ask, ask_events

MANY = 905


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daedalus.transport.status_query._PAGES_SECONDS", 100.0)


@pytest.fixture
def operator() -> MemoryTransport:
    return MemoryTransport(MemoryNetwork())


@pytest.fixture
def server(operator: MemoryTransport) -> Iterator[ActorServer]:
    """Server with many actors, half of which are present."""
    health = Health(started=0.0, updated=0.0, actor_seen=0.0)
    context = run_context(health=health)
    reporter = RunReporter(context, UserMetrics())
    opened = ActorServer(context, MemoryTransport(operator._network), lambda: reporter.status(0, 1.0))
    opened.open()
    for number in range(MANY):
        join = Join(actor=f"pod-{number}", incarnation=1, spaces=SPACES, environments=1)
        assert context.fleet.join(join, 0.0) is None
        context.fleet.set_present(join.actor, 1, number % 2 == 0, 0.0)
        context.fleet.actors[join.actor].quarantined = "x" * 500 if number == 2 else ""
    yield opened
    opened.close("the test is over")


def query(operator: MemoryTransport, payload: bytes) -> Message:
    (answer,) = operator.query(keys.status("r"), payload, timeout=1.0)
    return decode(answer, STATUS_LIMITS)


def test_status_contains_every_actor_of_a_large_fleet(server: ActorServer, operator: MemoryTransport) -> None:
    """The status of so many actors once exceeded the reader's limit, and Kubernetes restarted the learner."""
    (status,) = ask(operator)
    assert [actor.actor for actor in status.actors] == sorted(server.context.fleet.actors)
    assert (status.actors_alive, status.actors_quarantined, status.actors_gone) == (452, 1, 452)
    assert status.fleet_size == MANY


def test_number_of_fetched_actors_can_be_limited(server: ActorServer, operator: MemoryTransport) -> None:
    assert [len(ask(operator, max_actors=most)[0].actors) for most in (0, PAGE_ACTORS, PAGE_ACTORS + 1)] == [
        PAGE_ACTORS,
        PAGE_ACTORS,
        2 * PAGE_ACTORS,
    ]


def test_actor_that_leaves_between_two_pages_costs_no_other(server: ActorServer, operator: MemoryTransport) -> None:
    names = sorted(server.context.fleet.actors)
    report = query(operator, b"")
    assert isinstance(report, StatusReport)
    assert [actor.actor for actor in report.status.actors] == names[:PAGE_ACTORS]
    for name in (names[5], names[PAGE_ACTORS - 1]):
        del server.context.fleet.actors[name]
    more = query(operator, encode(ActorsRequest(after=names[PAGE_ACTORS - 1])))
    assert isinstance(more, ActorsReport)
    assert [actor.actor for actor in more.page.actors] == names[PAGE_ACTORS : 2 * PAGE_ACTORS]


def test_events_of_the_run_are_reported(server: ActorServer, operator: MemoryTransport) -> None:
    """Actors join, leave, return and are refused."""
    spaces = SPACES.model_copy(update={"actions": {"action": DiscreteSpace(counts=(7,))}})
    mismatch = Join(actor="other", incarnation=1, spaces=spaces, environments=1, origin=Origin(host="arm-box"))
    actor = MemoryTransport(operator._network)
    new = replace(mismatch, actor="new", spaces=SPACES)
    for join in (new, new, mismatch):
        actor.declare_presence(keys.presence("r", join.actor, join.incarnation))
        actor.query(keys.join("r", join.actor), encode(join), timeout=1.0)
    actor.close()
    again = MemoryTransport(operator._network)
    again.declare_presence(keys.presence("r", "new", 1))
    (status,) = ask(operator, max_actors=0)
    page = ask_events(operator, status)
    assert page is not None
    assert (page.run, page.learner_epoch) == ("r", EPOCH)
    found = [(event.kind, event.actor, event.text) for event in page.events]
    assert found[:2] == [("started", "", "serving run 'r'"), ("joined", "new", "joined with 1 environments (arm-box)")]
    assert found[2][:2] == ("refused", "other")
    assert found[2][2].startswith("refused (arm-box): the actor's environment has ")
    assert found[3:] == [("left", "new", "no longer connected"), ("joined", "new", "connected again")]


def test_events_of_the_longest_texts_fit_the_limits_of_their_reader() -> None:
    event = Event(time="t" * 24, kind="quarantined", actor="\N{EM DASH}" * 64, text="\N{EM DASH}" * 300, count=2**62)
    page = EventsPage(run="n" * 64, learner_epoch=2**62, events=(event,) * MAX_EVENTS)
    assert isinstance(decode(encode(EventsReport(page=page)), STATUS_LIMITS), EventsReport)


def test_page_after_the_last_actor_is_empty(server: ActorServer, operator: MemoryTransport) -> None:
    report = query(operator, encode(ActorsRequest(after="zzz")))
    assert isinstance(report, ActorsReport)
    assert report.page == ActorsPage(learner_epoch=EPOCH, actors=())


@pytest.mark.parametrize("payload", [b"x", encode(Join(actor="a", incarnation=1)), b"x" * 5000])
def test_invalid_request_is_refused(server: ActorServer, operator: MemoryTransport, payload: bytes) -> None:
    answer = query(operator, payload)
    assert isinstance(answer, Refusal)
    assert answer.code == "malformed"


def test_pages_of_a_learner_that_replaced_the_first_are_left_out(operator: MemoryTransport) -> None:
    first = tuple(actor_status(f"a{number:03}") for number in range(PAGE_ACTORS))
    status = encode(StatusReport(status=run_status(run="r", actors=first, actors_alive=500)))
    other = encode(ActorsReport(page=ActorsPage(learner_epoch=2, actors=(actor_status("b"),))))
    learner = MemoryTransport(operator._network)
    learner.serve(keys.status("r"), lambda request: request.reply(other if request.size else status))
    assert len(ask(operator)[0].actors) == PAGE_ACTORS


def test_page_of_the_longest_values_fits_the_limits_of_its_reader() -> None:
    causes = ("unknown_actor", "quarantined", "malformed", "duplicate", "non_finite", "surplus", "epoch", "stale")
    largest = 2**62
    actor = actor_status(
        "n" * 64,
        host="\N{EM DASH}" * 64,
        software="\N{EM DASH}" * 64,
        address="\N{EM DASH}" * 64,
        quarantined="\N{EM DASH}" * 300,
        lives=largest,
        env_steps=largest,
        rollouts_accepted=largest,
        rollouts_rejected=dict.fromkeys(causes, largest),
        rollouts_missed=largest,
        busy_answers=largest,
        policy_lag=largest,
        deadlines=largest,
        missed_deadlines=largest,
        overridden_actions=largest,
        safe_actions=largest,
        rollouts_dropped=largest,
        safe_reason="\N{EM DASH}" * 300,
    )
    data = encode(ActorsReport(page=ActorsPage(learner_epoch=largest, actors=(actor,) * PAGE_ACTORS)))
    assert isinstance(decode(data, STATUS_LIMITS), ActorsReport)
    refused = RefusedJoin(
        **dict.fromkeys(("actor", "host", "software"), "\N{EM DASH}" * 64),
        reason="\N{EM DASH}" * 300,
        count=largest,
        seconds_since_last=1.0,
    )
    status = run_status(actors=(actor,) * PAGE_ACTORS, refused_joins=(refused,) * 32, problems=("x" * 1000,) * 5)
    assert isinstance(decode(encode(StatusReport(status=status)), STATUS_LIMITS), StatusReport)
    decode(encode(ActorsRequest(after="n" * 64)), STATUS_REQUEST_LIMITS)


def test_exporter_has_totals_of_all_actors_and_series_of_the_first_thousand(
    server: ActorServer,
    operator: MemoryTransport,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("daedalus.launch.prometheus_exporter._MAX_ACTORS", 2 * PAGE_ACTORS)
    collector = StatusCollector()
    collector.transport = operator
    samples = []
    for _ in range(2):
        samples = [sample for family in collector.collect() for sample in family.samples]
    counts = {sample.labels["state"]: sample.value for sample in samples if sample.name == "daedalus_actors"}
    assert counts == {"alive": 452, "quarantined": 1, "gone": 452}
    series = {sample.labels["actor"] for sample in samples if "actor" in sample.labels}
    present = [name for name in sorted(server.context.fleet.actors)[: 2 * PAGE_ACTORS] if int(name[4:]) % 2 == 0]
    assert series == set(present)
    (warning,) = caplog.messages
    assert f"has 905 actors: {2 * PAGE_ACTORS} of them have metrics of their own" in warning


@pytest.mark.usefixtures("server")
def test_a_run_that_is_not_there_is_named_with_those_that_are(
    operator: MemoryTransport, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("daedalus.cli.commands.status.connect_once", lambda *_: operator)
    assert status_command(["--connect", "tcp/127.0.0.1:1", "--run", "other"]) == 1
    assert capsys.readouterr().err == "daedalus status: no learner of run 'other' answers; the runs here are 'r'\n"


# -------------------------------------------------------------------------------------------- --alive


def test_alive_depends_on_the_age_of_the_heartbeat_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 5000.0
    monkeypatch.setattr(heartbeat, "time", SimpleNamespace(monotonic=lambda: now))
    alive, beating = ["--alive", str(tmp_path)], heartbeat.Heartbeat(tmp_path)
    assert status_command(alive) == 0  # the learner waits for its router
    assert capsys.readouterr().out == f"no learner works in {tmp_path}: it has ended, or not begun yet\n"
    (tmp_path / "other").touch()
    assert status_command(alive) == 1
    assert "is not a run directory: it has no config.toml" in capsys.readouterr().err
    (tmp_path / "config.toml").touch()
    assert status_command(alive) == 0
    assert capsys.readouterr().out == f"no learner works in {tmp_path}: it has ended, or not begun yet\n"
    beating.beat()
    now += 119.0
    assert status_command(alive) == 0
    assert capsys.readouterr() == ("", "")
    now += 2.0
    assert status_command(alive) == 1
    assert capsys.readouterr().err == f"daedalus status: the learner of {tmp_path} has been silent for 121 s\n"
    beating.beat()
    assert status_command(alive) == 0
    now += 121.0
    monkeypatch.setattr(heartbeat, "_BOOT", tmp_path / "missing")
    assert status_command(alive) == 0  # the file is of before the machine restarted
    monkeypatch.undo()
    beating.clear()
    assert status_command(alive) == 0


def test_a_directory_that_does_not_exist_is_not_alive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_command(["--alive", str(tmp_path / "typo")]) == 1
    assert capsys.readouterr().err == f"daedalus status: {tmp_path / 'typo'} does not exist: name a run directory\n"


@pytest.mark.parametrize("content", ["", "x", "12 y z", "nan -"])
def test_unreadable_heartbeat_is_no_reason_for_a_restart(tmp_path: Path, content: str) -> None:
    (tmp_path / "config.toml").touch()
    (tmp_path / heartbeat.HEARTBEAT).write_text(content)
    assert status_command(["--alive", str(tmp_path)]) == 0


def test_heartbeat_that_cannot_be_written_does_not_raise(tmp_path: Path) -> None:
    missing = heartbeat.Heartbeat(tmp_path / "missing")
    missing.beat()
    missing.clear()


def test_address_and_alive_exclude_one_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in ([], ["--alive", str(tmp_path), "--connect", "tcp/127.0.0.1:1"]):
        with pytest.raises(SystemExit):
            status_command(arguments)
    assert "--alive" in capsys.readouterr().err


def test_of_two_learners_of_a_run_both_are_shown_and_the_newer_is_named(
    operator: MemoryTransport, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A learner of another release, which nobody here can read, hides neither."""
    newer = bytearray(encode(Refusal(code="unknown", reason="")))
    newer[4] += 1  # the version
    for answer in (
        encode(StatusReport(status=run_status(learner_epoch=0x1F, actors=(actor_status("a"),)))),
        bytes(newer),
        encode(StatusReport(status=run_status(learner_epoch=0x2F, actors=(actor_status("a"),)))),
    ):
        learner = MemoryTransport(operator._network)
        learner.serve(keys.status("mine"), lambda request, answer=answer: request.reply(answer))
    shown = ask(operator)
    assert [status.learner_epoch for status in shown] == [0x2F, 0x1F]
    assert not shown[0].problems
    problem = "the learner with epoch 1f is not the newest of this run: actors follow epoch 2f"
    assert shown[1].problems[0].startswith(problem)
    assert LearnerSource(operator).status(0).learner_epoch == 0x2F  # type: ignore[union-attr]
    monkeypatch.setattr("daedalus.cli.commands.status.connect_once", lambda *_: operator)
    assert status_command(["--connect", "tcp/127.0.0.1:1", "--quiet"]) == 3
    assert "mine: the learner with epoch 1f is not the newest" in capsys.readouterr().out


def of_another_version() -> bytes:
    answer = bytearray(encode(Refusal(code="unknown", reason="")))
    answer[4] += 1
    return bytes(answer)


def crowded(*actors: ActorStatus) -> bytes:
    """Return a status whose further actors are on pages of their own."""
    status = run_status(run="other", learner_epoch=7, actors=actors)
    return encode(StatusReport(status=status.model_copy(update={"actors_alive": 200})))


TWINS = ActorsPage(learner_epoch=7, actors=(actor_status("x"), actor_status("y")) * 2)
OTHERS = {
    "another version": (of_another_version(), b"", "run 'other' is left out: its learner is of another release"),
    "no message": (b"garbage", b"", "run 'other' is left out: what answers for its learner is not one"),
    "another message": (encode(Acknowledgement(verdict="accepted")), b"", "find out which process serves"),
    "pages of another version": (crowded(actor_status("x")), of_another_version(), "run 'other' is shown in part"),
    "actors twice": (crowded(actor_status("x"), actor_status("x")), encode(ActorsReport(page=TWINS)), ""),
}


@pytest.mark.parametrize(("answer", "page", "said"), OTHERS.values(), ids=OTHERS)
def test_another_release_hides_no_run_and_is_named(
    operator: MemoryTransport,
    answer: bytes,
    page: bytes,
    said: str,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    foreign, ours = MemoryTransport(operator._network), MemoryTransport(operator._network)
    foreign.serve(keys.status("other"), lambda request: request.reply(page if request.size else answer))
    report = encode(StatusReport(status=run_status(actors=(actor_status("a"),))))
    ours.serve(keys.status("mine"), lambda request: request.reply(report))
    registry, collector = CollectorRegistry(), StatusCollector()
    collector.transport = operator
    registry.register(collector)
    scraped = generate_latest(registry).decode()
    lines = [line for line in scraped.splitlines() if not line.startswith("#")]
    assert len(lines) == len(
        {line.rpartition(" ")[0] for line in lines}
    )  # Prometheus refuses a series that is there twice
    assert "daedalus_up 1.0" in lines
    assert 'daedalus_healthy{run="mine"} 1.0' in lines
    assert ('daedalus_unreadable{run="other"} 1.0' in lines) == ("left out" in said or "find out" in said)
    assert said in caplog.text
    monkeypatch.setattr("daedalus.cli.commands.status.connect_once", lambda *_: operator)
    assert status_command(["--connect", "tcp/127.0.0.1:1"]) == 0
    shown = capsys.readouterr()
    assert "run mine: CartPole-v1" in shown.out
    assert said in shown.err + caplog.text


def test_only_answers_of_another_release_are_an_error(operator: MemoryTransport) -> None:
    newer = bytearray(encode(Refusal(code="unknown", reason="")))
    newer[4] += 1
    MemoryTransport(operator._network).serve(keys.status("mine"), lambda request: request.reply(bytes(newer)))
    with pytest.raises(ProtocolError, match="protocol version"):
        ask(operator)
