"""`daedalus actor --stay`: which failures end it. The attempts are replaced by a script."""

import sys
import threading
from contextlib import ExitStack
from typing import Any

import pytest
from log_lines import LINES

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.errors import ActorError, ActorRefusedError, NameInUseError, NoLearnerError
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.cli.commands import actor as command
from daedalus.launch import actor_process
from daedalus.launch.logs import LogOptions
from daedalus.policy.acting.runtime import PolicyError
from daedalus.transport.credentials import CredentialsError, NotValidNowError
from daedalus.transport.interface import RefusedError, TransportError, UnreachableError

OF_OTHERS = [
    ActorError("several learners answer here (one, two): choose one with --run"),
    ActorError("the other end uses protocol version 12, this one 11"),
    ActorRefusedError("the learner refused this actor: its environment has 3 choices"),
    ActorRefusedError("the learner quarantined this actor: 3 unfit rollouts in a row"),
    NameInUseError("actor name 'a' is already in use"),
    EnvironmentSetupError("no module x"),
    PolicyError("the program does not run"),
    RefusedError("the certificate of the service cannot be verified: certificate has expired"),
    TransportError("the session is closed"),
]
OWN = [NoLearnerError("no learner answered within 5 s"), UnreachableError("nothing answers (for 5 s)")]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the attempts raise or return, one after the other; the pauses between them are short."""
    stop, left, incarnations = threading.Event(), list[Any](), set[int]()

    class ScriptedActor:
        def __init__(self, config: ActorConfig, *_: object, **__: object) -> None:
            assert config.incarnation not in incarnations, "a quarantined incarnation stays quarantined"
            incarnations.add(config.incarnation)

        def run(self) -> bool:
            result = left.pop(0)
            if isinstance(result, Exception):
                raise result
            return result

    monkeypatch.setattr(command, "stop_on_signals", lambda **_: stop)
    monkeypatch.setattr(LogOptions, "configure", lambda *_, **__: None)
    monkeypatch.setattr(actor_process, "connect_with_retry", lambda *_: ExitStack())
    monkeypatch.setattr(actor_process, "ActorService", ScriptedActor)
    monkeypatch.setattr(actor_process, "_NEXT_RUN_SECONDS", 0.0)
    monkeypatch.setattr("daedalus.transport.retries._MAX_PAUSE_SECONDS", 0.001)
    monkeypatch.setattr("daedalus.transport.retries._FIRST_PAUSE_SECONDS", 0.001)
    return left


def run(monkeypatch: pytest.MonkeyPatch, *options: str) -> int:
    monkeypatch.setattr(sys, "argv", ["actor", "--connect", "tcp/127.0.0.1:1", *options])
    return command.main()


def test_a_standing_actor_ends_for_no_cause_of_others(script: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    script += [*OF_OTHERS, True, *OF_OTHERS, False]  # twice over, with a run that is over, until it is drained
    assert run(monkeypatch, "--stay") == 0
    assert not script
    for error in OF_OTHERS:
        assert sum(line.startswith(str(error)) for line in LINES) == 2


@pytest.mark.parametrize("error", [*OF_OTHERS, *OWN], ids=str)
def test_an_actor_that_does_not_stay_ends_with_the_reason(
    script: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception
) -> None:
    script.append(error)
    assert run(monkeypatch) == 1
    assert capsys.readouterr().err == f"daedalus actor: {error}\n"


@pytest.mark.parametrize("error", OWN, ids=str)
def test_the_time_that_the_user_set_ends_a_standing_actor(
    script: list[Any], monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    script.append(error)
    assert run(monkeypatch, "--stay", "--timeout", "5") == 1


def test_a_fault_of_ours_is_no_cause_of_others(script: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    assert not actor_process._is_of_others(ZeroDivisionError())


@pytest.mark.parametrize(("stays", "status"), [(False, 1), (True, 0)])
def test_a_certificate_that_is_not_valid_now_is_no_bad_usage(
    script: list[Any], monkeypatch: pytest.MonkeyPatch, stays: bool, status: int
) -> None:
    answers: list[Any] = [NotValidNowError("the certificate expired on 2030-01-01")] * (3 if stays else 1)

    def credentials(*_: object) -> None:
        if answers:
            raise answers.pop()

    monkeypatch.setattr(actor_process, "credentials_to_connect", credentials)
    script.append(False)
    assert run(monkeypatch, *(["--stay"] if stays else [])) == status
    assert not answers


def test_bad_usage_ends_a_standing_actor_at_its_start(script: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def credentials(*_: object) -> None:
        raise CredentialsError("certs has no ca.pem")

    assert run(monkeypatch, "--stay", "--envs", "0") == 2
    monkeypatch.setattr(actor_process, "credentials_to_connect", credentials)
    assert run(monkeypatch, "--stay") == 2


@pytest.mark.parametrize(
    ("address", "link", "used"),
    [
        ("unixsock-stream/tmp/x/learner", "auto", "lan"),
        ("unixsock-stream/tmp/x/learner", "wan", "wan"),
        ("tcp/127.0.0.1:7447", "auto", "auto"),
    ],
)
def test_a_unix_socket_is_never_measured_as_a_slow_link(address: str, link: Any, used: str) -> None:
    options = actor_process.ActorOptions(connect=[address], link=link)
    assert options.config(None).link == used
