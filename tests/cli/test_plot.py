"""Test of cli/commands/plot.py."""

import math
from pathlib import Path

import pytest

from daedalus.cli.commands.plot import _evaluations, plot

ROWS = """\
env_steps,episode_return_mean,episode_return_std,entropy,value_loss,policy_lag_mean,evaluation_env_steps,evaluation_return_mean
100,1.0,0.5,2.0,3.0,1.0,,
200,2.0,0.5,1.9,2.0,1.0,150,7.0
300,3.0,0.5,1.8,1.0,1.0,150,7.0
400,4.0,0.5,1.7,0.5,1.0,350,9.0
"""


def test_each_evaluation_becomes_one_point() -> None:
    nan = math.nan
    run = {"evaluation_env_steps": [nan, 150.0, 150.0, 350.0], "evaluation_return_mean": [nan, 7.0, 7.0, 9.0]}
    assert _evaluations(run) == ([150.0, 350.0], [7.0, 9.0])
    assert _evaluations({"env_steps": [1.0]}) == ([], [])


def test_plot_writes_a_picture_of_a_run_with_evaluations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "metrics.csv").write_text(ROWS)
    assert plot([str(tmp_path), "--output", str(tmp_path / "curve.png")]) == 0, capsys.readouterr().err
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_without_metrics_is_reported_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(directory: Path) -> str:
        assert plot([str(directory), "--output", str(tmp_path / "curve.png")]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("daedalus plot: ")

    nothing = refused(tmp_path / "nowhere")
    assert nothing == f"{tmp_path}/nowhere is not a run directory: it has neither config.toml nor metrics.csv"
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.toml").touch()
    assert refused(run) == f"{run} has no metrics yet: wait until the run has made its first updates"
    (run / "metrics.csv").write_text(ROWS.splitlines()[0])
    assert refused(run) == f"{run} has no metrics yet: wait until the run has made its first updates"
    (run / "metrics.csv").write_text("a,b\n1,2\n")
    assert refused(run) == f"{run}/metrics.csv has no column entropy: it is not the metrics of a run"
