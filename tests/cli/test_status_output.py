"""`daedalus status` as a person and a program read it: hosts, clients, refused joins, hostile texts."""

import json
from collections.abc import Callable

import pytest
from league_statuses import LEAGUE
from statuses import actor_status, run_status

from daedalus.cli.commands.status import _client_texts
from daedalus.cli.commands.status import status as status_command
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.league import RatedPlayer
from daedalus.protocol.messages import Event, EventsPage, EventsReport, RefusedJoin, RunStatus, StatusReport
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

CONNECT = ("--connect", "tcp/127.0.0.1:7447")
Print = Callable[..., str]


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Print:
    """Function that returns what the command prints about a status."""

    def show(status: RunStatus, *options: str) -> str:
        network = MemoryNetwork()
        learner = MemoryTransport(network)
        answers = {0: StatusReport(status=status)}  # by the size of the request
        learner.serve(
            keys.status(status.run),
            lambda request: request.reply(encode(answers.get(request.size, EventsReport(page=events_page())))),
        )
        connect = "daedalus.cli.commands.status.connect_once"
        monkeypatch.setattr(connect, lambda *_: MemoryTransport(network))
        assert status_command([*CONNECT, *options]) == (3 if status.problems else 0)
        return capsys.readouterr().out

    return show


def refused_join(**changes: str) -> RefusedJoin:
    texts = {"actor": "arm-2", "host": "arm-box", "software": "daedalus-rl 0.9", "reason": "protocol version 5"}
    return RefusedJoin(**{**texts, **changes}, count=3, seconds_since_last=7.0)  # type: ignore[arg-type]


def test_actors_are_shown_with_host_address_and_software(printed: Print) -> None:
    actors = actor_status("arm-1"), actor_status("arm-2", address=""), actor_status("pi", host="", software="")
    lines = printed(run_status(actors=actors)).splitlines()
    assert "  on gpu-box, daedalus-rl 1.0: arm-1 (tcp/10.0.0.7:43092), arm-2" in lines
    assert "  on an unknown host: pi (tcp/10.0.0.7:43092)" in lines


def test_state_fits_100_columns_and_names_what_it_leaves_out(printed: Print) -> None:
    actors = tuple(
        actor_status(f"{'n' * 40}-{lives}", lives=lives, epsilon=0.1, env_steps=10**9, rollouts_missed=3)
        for lives in (1, 2)
    )
    lines = printed(run_status(actors=actors, problems=("why " * 100,), updates_per_batch=160)).splitlines()
    assert max(map(len, lines)) <= 100
    assert "  --json has more columns: down, MB/h up, accepted, envs, lives, epsilon, env_steps" in lines


def test_policy_lag_is_shown_in_batches(printed: Print) -> None:
    actors = actor_status("arm-1", policy_lag=160), actor_status("arm-2", policy_lag=400)
    shown = printed(run_status(policy_lag_mean=80.0, updates_per_batch=160, actors=actors))
    for part in ("policy lag 0.5 batches (80 updates)", "  1 batch  ", "  2.5 batches  "):
        assert part in shown
    assert "policy lag 0.8 updates" in printed(run_status(policy_lag_mean=0.75))


def test_players_of_a_league_are_listed_by_rating(printed: Print) -> None:
    shown = printed(run_status(league=LEAGUE, episode_return_mean=0.0)).splitlines()
    assert any(line.startswith("  rating 1,312 +- 50, return 0, env_steps 100 of") for line in shown)
    begin = next(index for index, line in enumerate(shown) if line.split()[0] == "player")
    assert [line.split() for line in shown[begin + 1 : begin + 7]] == [
        ["newest", "1,312", "50", "1,200", "-"],
        ["v200", "300", "10", "70", "95%"],
        ["v100", "280", "15", "80", "-"],
        ["my_bots:Greedy", "250", "10", "60", "75%"],
        ["v0", "200", "20", "90", "25%"],
        ["random", "0", "0", "50", "97%"],
    ]
    versions = tuple(RatedPlayer(player=f"v{number}", rating=number, deviation=1.0) for number in range(20))
    many = LEAGUE.model_copy(update={"players": (*LEAGUE.players[:1], *versions, *LEAGUE.players[-2:]), "left_out": 3})
    shown = printed(run_status(league=many))
    assert "... and 14 more players" in shown
    assert all(name in shown for name in ("newest ", "v19 ", "random ", "my_bots:Greedy "))
    assert json.loads(printed(run_status(league=many), "--json"))["league"]["left_out"] == 3


def test_the_epsilon_of_an_actor_that_explores_is_shown(printed: Print) -> None:
    shown = printed(run_status(actors=(actor_status("arm-1", epsilon=0.5), actor_status("arm-2"))))
    cells = {line.split()[0]: line.split() for line in shown.splitlines() if " alive " in line}
    column = next(line.split() for line in shown.splitlines() if "epsilon" in line).index("epsilon")
    assert (cells["arm-1"][column + 1], cells["arm-2"][column + 1]) == ("0.5", "-")  # `0.5 s` of `seen` is two words


def test_refused_joins_are_shown_with_host_version_and_reason(printed: Print) -> None:
    status = run_status(refused_joins=(refused_join(), refused_join(host="", software="")))
    assert printed(status).splitlines()[-2:] == [
        "  refused: arm-2 (arm-box, daedalus-rl 0.9), 3 x, last 7 s ago: protocol version 5",
        "  refused: arm-2, 3 x, last 7 s ago: protocol version 5",
    ]
    assert json.loads(printed(status, "--json"))["refused_joins"][0]["host"] == "arm-box"


def events_page() -> EventsPage:
    events = (
        Event(time="2026-11-22T13:16:45.123Z", kind="joined", actor="arm-1", text="joined", count=1),
        Event(time="2026-11-22T13:17:45.123Z", kind="rejected", actor="arm-1", text="a\x1b[2J\nb", count=1200),
        Event(time="2026-11-22T13:18:45.123Z", kind="checkpoint", actor="", text="checkpoint saved", count=1),
    )
    return EventsPage(run="mine", learner_epoch=1, events=events)


def test_events_are_shown_with_time_kind_actor_and_count(printed: Print) -> None:
    lines = printed(run_status(), "--events").splitlines()
    assert [" ".join(line.split()) for line in lines] == [
        "run mine: epoch 1, the newest events",
        "2026-11-22T13:16:45.123Z joined arm-1 joined",
        "2026-11-22T13:17:45.123Z rejected arm-1 a\\x1b[2J b (1,200 times)",
        "2026-11-22T13:18:45.123Z checkpoint - checkpoint saved",
    ]
    assert json.loads(printed(run_status(), "--events", "--json")) == events_page().model_dump(mode="json")


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_texts_of_peers_cannot_command_the_terminal_or_begin_lines(printed: Print, options: tuple[str, ...]) -> None:
    evil = "\x1b[2J\nPROBLEM: none\r\x9b31m"
    actor = actor_status("a", host=evil, software=evil, address=evil, quarantined=evil)
    refused = refused_join(actor=evil, host=evil, software=evil, reason=evil)
    output = printed(run_status(actors=(actor,), refused_joins=(refused,)), *options)
    assert not {"\x1b", "\r", "\x9b"} & set(output)
    assert not any(line.startswith("PROBLEM") for line in output.splitlines())


def test_an_actor_that_reports_nothing_has_no_line() -> None:
    assert _client_texts(actor_status("a")) == []


def test_a_client_has_lines_with_its_counts() -> None:
    client = actor_status(
        "a", deadlines=1200, missed_deadlines=3, rows=200, overridden_actions=5, safe_actions=40, rollouts_dropped=2
    )
    assert _client_texts(client) == [
        "counts 3 of 1,200 deadlines missed, 5 actions overridden (2.5%), 40 safe actions, 2 rollouts dropped"
    ]
    assert _client_texts(actor_status("a", deadlines=1200)) == ["counts 0 of 1,200 deadlines missed"]
    assert _client_texts(actor_status("a", safe_reason="why")) == ["plays the safe action: why"]
    assert _client_texts(actor_status("a", safe_reason="why", alive=False)) == []
