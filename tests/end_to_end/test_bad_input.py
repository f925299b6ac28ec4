"""Test of mistakes on the command line: one line that says what to do, and an exit status other than 0."""

import re
import signal
import subprocess
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from certificates import make_certificates
from processes import DAEDALUS, LIMIT, Running, until

from daedalus.cli.command_table import COMMANDS
from daedalus.cli.commands.actor import _run_group, actor_options, parser
from daedalus.cli.commands.learner import learner_options
from daedalus.cli.commands.learner import parser as learner_parser
from daedalus.launch.actor_process import LeaveRequest, run_actor
from daedalus.launch.learner_process import LearnerProcess
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run.settings import SettingsError
from daedalus.transport.zenoh_transport import listen

Start = Callable[..., Running]


def test_an_actor_that_finds_nobody_says_so_in_one_line(start: Start) -> None:
    running = start("actor", "--connect", "tcp/127.0.0.1:1", "--timeout", "0.3")
    assert running.wait() == 1, running.output
    running.expect(r"nothing answers at tcp/127.0.0.1:1: is the learner or router running, .* \(tried for 0.3 s\)")
    assert len(running.lines) == 1, running.output


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["train", "cartpol"], 2, r"unknown preset 'cartpol': did you mean cartpole"),
        (["train", "cartpole", "--set", "learning_rate=7"], 2, r"write section.key=value"),
        (["train", "cartpole", "--actors", "0"], 2, r"collection.actors .* at least 1"),
        (["resume", "nowhere"], 2, r"nowhere is not a run directory"),
        (["train", "cartpole", "--init-from", "nowhere"], 2, r"--init-from: nowhere does not exist"),
        (["plot", "nowhere", "--output", "x.png"], 1, r"nowhere does not exist: name a run directory"),
        (["status", "--connect", "tcp/127.0.0.1:1"], 1, r"nothing answers at tcp/127.0.0.1:1"),
    ],
)
def test_the_function_of_a_command_reports_a_mistake_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    words: list[str],
    status: int,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert COMMANDS[words[0]].run(words[1:]) == status
    (line,) = "".join(capfd.readouterr()).splitlines()
    assert re.search(message, line)
    assert not list(tmp_path.iterdir())


def test_an_actor_reports_a_mistake_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    certificates = make_certificates(tmp_path / "certs")
    tcp, tls = ("--connect", "tcp/127.0.0.1:1"), ("--connect", "tls/127.0.0.1:1")
    for words, message in (
        ((*tcp, "--envs", "0"), "--envs is 0: choose a number from 1 to 4096"),
        ((*tcp, "--name", "a/b"), "actor name 'a/b' must be"),
        (tls, "needs certificates: --tls DIR"),
        ((*tls, "--tls", certificates / "learner"), "holds the certificate of learner, but actor is required"),
        ((*tls, "--tls", certificates / "actor-arm", "--name", "box"), "is not for 'box': use --name arm or arm.ANY"),
    ):
        options = actor_options(parser().parse_args([*map(str, words)]))
        assert run_actor(options, threading.Event(), {}, LeaveRequest()) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("daedalus actor: ")
        assert message in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--actors", "0"), "--actors is 0: choose a number from 1"),
        (
            ("--inference", "cuda", "--runtime", "onnx"),
            "--inference cuda runs the policy with torch: leave out --runtime onnx",
        ),
    ],
)
def test_a_group_of_actors_reports_a_mistake_in_one_line(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], message: str
) -> None:
    assert _run_group(parser().parse_args(["--connect", "tcp/127.0.0.1:1", *words])) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"daedalus actor: {message}")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["CartPoll-v1"], "unknown environment 'CartPoll-v1': did you mean CartPole-v1"),
        (
            ["faulty_environments:Faulty-v0", "--set", "environment.kwargs.fault=shape"],
            r"Faulty-v0: reset returns an observation of shape \(3,\), but observation_space has shape \(2,\)",
        ),
    ],
)
def test_a_fault_of_the_environment_is_reported_once_before_anything_starts(
    start: Start, tmp_path: Path, words: list[str], message: str
) -> None:
    run = tmp_path / "run"
    running = start("train", "--env", *words, "--run-dir", run, directory=Path(__file__).parent.parent)
    assert running.wait() == 1
    running.expect(message)
    assert len(running.lines) == 1, running.output
    assert not run.exists()


def test_a_signal_ends_the_check_of_an_environment_that_hangs(start: Start, tmp_path: Path) -> None:
    words = ["faulty_environments:Faulty-v0", "--set", "environment.kwargs.fault=hang", "--run-dir", tmp_path / "run"]
    running = start("train", "--env", *words, directory=Path(__file__).parent.parent)
    process = running.process.pid
    children = Path(f"/proc/{process}/task/{process}/children")
    until(lambda: children.read_text())
    running.process.send_signal(signal.SIGTERM)
    assert running.wait() == 1
    assert running.lines == ["stopped"]
    assert not (tmp_path / "run").exists()


def test_a_learner_whose_algorithm_cannot_be_imported_starts_no_run(tmp_path: Path) -> None:
    words = ["cartpole", "--algorithm", "absent:A", "--run-dir", str(tmp_path / "run")]
    options = learner_options(learner_parser().parse_args(words), 0.0, tmp_path)
    with pytest.raises(SettingsError, match=r"training\.algorithm=absent:A: cannot import absent"):
        LearnerProcess(options, threading.Event(), UserMetrics())
    assert not (tmp_path / "run").exists()


def test_an_existing_run_directory_is_refused_and_not_changed(start: Start, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "precious").write_text("kept")
    running = start("train", "cartpole", "--run-dir", "run")
    assert running.wait() == 2
    running.expect(r"run directory run is not empty, and has no config\.toml: choose another directory")
    assert [entry.name for entry in (tmp_path / "run").iterdir()] == ["precious"]


def test_a_training_whose_learner_fails_at_its_start_says_why_and_leaves_nothing(
    start: Start, address: str, tmp_path: Path
) -> None:
    with closing(listen([address])):
        running = start("train", "cartpole", "--listen", address, "--actors", 1, "--run-dir", "run")
        assert running.wait() == 1
    running.expect(f"daedalus learner: address .*, {address} is already in use")
    assert "Traceback" not in running.output
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_examples(command: str) -> None:
    assert "examples:" in COMMANDS[command].make_parser().format_help()


def test_help_of_a_command_that_reserves_its_output_can_be_piped() -> None:
    ended = subprocess.run([*DAEDALUS, "evaluate", "--help"], capture_output=True, text=True, timeout=LIMIT, check=True)
    assert ended.stdout.startswith("usage: daedalus evaluate")
    assert ended.stderr == ""
