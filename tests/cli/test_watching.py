"""`daedalus train --watch`: what is refused, and how; and the other runs that the page shows."""

from pathlib import Path

import pytest

from daedalus.cli.commands import train
from daedalus.launch.gateway_process import MAX_RUNS, OtherRuns


def test_watch_without_the_extra_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert train.train(["cartpole", "--watch", "--run-dir", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("daedalus train: --watch: the gateway needs starlette")
    assert 'pip install "daedalus-rl[gateway]"' in line
    assert not (tmp_path / "run").exists()


def test_clients_without_a_page_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train.train(["cartpole", "--clients", "--run-dir", str(tmp_path / "run")]) == 2
    assert "--clients is for the page of the run: add --watch" in capsys.readouterr().err


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
