"""`daedalus train --watch` and the page's files on the command line: what is refused, and how."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import LIMIT, Running
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from daedalus.cli.commands import train
from daedalus.launch.gateway_process import MAX_RUNS, OtherRuns

Start = Callable[..., Running]


def test_watch_without_the_extra_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert train.train(["cartpole", "--watch", "--run-dir", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("daedalus train: --watch: the gateway needs starlette")
    assert 'pip install "daedalus-rl[gateway]"' in line
    assert not (tmp_path / "run").exists()


def test_watch_serves_the_page_only_and_shows_it_to_the_operator_only(start: Start, tmp_path: Path) -> None:
    run = start("train", "cartpole", "--watch", "--run-dir", "run", "--actors", 1)
    port = run.expect(r"watch the run at http://127\.0\.0\.1:(\d+)/ with the token in run/operator-token$")[1]
    for path in ("actor", "raw"):
        with pytest.raises(InvalidStatus):
            connect(f"ws://127.0.0.1:{port}/{path}", open_timeout=LIMIT)
    file = tmp_path / "run" / "operator-token"
    assert file.stat().st_mode & 0o077 == 0
    for token, answer in (("", "error"), (file.read_text().strip(), "hello")):
        with connect(f"ws://127.0.0.1:{port}/watch", open_timeout=LIMIT) as page:
            page.send(json.dumps({"type": "hello", "token": token}))
            assert json.loads(page.recv(timeout=LIMIT))["type"] == answer
    run.process.terminate()
    assert run.wait() == 1


def test_clients_without_a_page_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train.train(["cartpole", "--clients", "--run-dir", str(tmp_path / "run")]) == 2
    assert "--clients is for the page of the run: add --watch" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--compare", "nowhere"), "nowhere has no metrics.csv: it is no run directory"),
        (("--operator", "certs"), "--operator is for networks with certificates"),
        (("--operator-token", "token"), "token has no token of 16 to 256 characters: delete the file"),
    ],
)
def test_wrong_files_are_refused_in_one_line(
    start: Start, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    (tmp_path / "token").write_text("short\n")
    gateway = start("gateway", "--connect", "tcp/127.0.0.1:1", *arguments)
    assert gateway.wait() == 2
    (line,) = gateway.lines
    assert line.startswith("daedalus gateway: ")
    assert message in line


def test_other_runs_are_read_again_when_they_change(tmp_path: Path) -> None:
    path = tmp_path / "older" / "metrics.csv"
    path.parent.mkdir()
    path.write_text("env_steps,entropy\n1,0.5\n")
    runs = OtherRuns([path.parent])
    assert [(run.name, run.rows) for run in runs()] == [("older", [{"env_steps": 1.0, "entropy": 0.5}])]
    path.write_text("env_steps,entropy\n1,0.5\n2,0.25\n")
    assert len(runs()[0].rows) == 2
    path.unlink()
    assert len(runs()[0].rows) == 2  # as it was


def test_too_many_other_runs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"at most {MAX_RUNS}"):
        OtherRuns([tmp_path] * (MAX_RUNS + 1))
