"""Test of `daedalus plot`."""

import errno
from pathlib import Path

import numpy as np
import pytest
from league_statuses import LEAGUE
from recorded_runs import record

from daedalus.analysis.charts import COLUMNS
from daedalus.analysis.learning_curves import evaluations
from daedalus.analysis.recorded_run import read_run
from daedalus.cli.commands.plot import plot

EVALUATED = """\
wall_seconds,env_steps,episode_return_mean,evaluation_env_steps,evaluation_return_mean
60,100,1.0,,
120,200,2.0,150,7.0
180,300,3.0,150,7.0
240,400,4.0,350,9.0
"""


def test_each_evaluation_becomes_one_point(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text(EVALUATED)
    run = read_run(tmp_path)
    assert [values.tolist() for values in evaluations(run, "env_steps")] == [[150.0, 350.0], [7.0, 9.0]]
    assert [values.tolist() for values in evaluations(run, "minutes")] == [[1.5, 3.5], [7.0, 9.0]]
    (tmp_path / "metrics.csv").write_text("env_steps,episode_return_mean\n1,2\n")
    assert [len(values) for values in evaluations(read_run(tmp_path), "env_steps")] == [0, 0]


@pytest.mark.parametrize(
    "options", [(), ("--by", "minutes"), ("--profile",)], ids=lambda options: " ".join(options) or "curves"
)
def test_plot_writes_a_picture_of_groups_and_single_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...]
) -> None:
    pytest.importorskip("matplotlib")
    for seed in (1, 2, 3):
        record(tmp_path / f"five-{seed}", seed=seed, settings=["collection.rollout_length=5"], evaluation=400.0 + seed)
    record(tmp_path / "one", returns=(None, None, 3.0))
    record(tmp_path / "game", returns=(0.0, 0.0, 0.0), league=LEAGUE)
    picture = tmp_path / "curve.png"
    assert plot([*options, str(tmp_path), "--output", str(picture)]) == 0, capsys.readouterr().err
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().err == ""


def test_a_full_disk_leaves_the_picture_that_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    def savefig(_figure: Figure, path: Path, **_options: object) -> None:
        path.write_bytes(b"half of it")
        raise OSError(errno.ENOSPC, "No space left on device")

    record(tmp_path / "one")
    picture = tmp_path / "curve.png"
    picture.write_bytes(b"the one before")
    monkeypatch.setattr(Figure, "savefig", savefig)
    assert plot([str(tmp_path / "one"), "--output", str(picture)]) == 1
    assert capsys.readouterr().err == f"daedalus plot: {picture}: No space left on device\n"
    assert picture.read_bytes() == b"the one before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["curve.png", "one"]


def test_a_curve_is_drawn_for_each_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seeds of one setting are one curve."""
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    for seed in (1, 2, 3):
        for length in (5, 20):
            settings = [f"collection.rollout_length={length}"]
            record(tmp_path / f"{length}-{seed}", seed=seed, settings=settings, returns=(10.0 * seed,) * 3)
    record(tmp_path / "one", settings=["collection.rollout_length=30"])
    figures: list[Figure] = []

    def savefig(figure: Figure, path: Path, **_options: object) -> None:
        figures.append(figure)
        path.touch()

    monkeypatch.setattr(Figure, "savefig", savefig)
    assert plot([str(tmp_path), "--output", str(tmp_path / "curve.png")]) == 0
    axis = figures[0].axes[0]
    assert [line.get_label() for line in axis.get_lines()] == [
        "rollout_length=5 (3 runs)",
        "rollout_length=20 (3 runs)",
        "rollout_length=30",
    ]
    assert axis.get_title().endswith("band: 95 % interval of the runs; of one run one std; circles: evaluations)")
    assert np.all(axis.get_lines()[0].get_ydata() == 20.0)
    (low, high) = axis.collections[0].get_datalim(axis.transData).intervaly
    assert (low, high) == (10.0, 30.0)


def test_each_environment_has_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    record(tmp_path / "a", settings=["environment.id=ALE/Pong-v5"])
    record(tmp_path / "b")
    assert plot([str(tmp_path), "--output", str(tmp_path / "curve.png")]) == 0
    names = ["curve-ALE-Pong-v5.png", "curve-CartPole-v1.png"]
    assert sorted(path.name for path in tmp_path.glob("*.png")) == names
    assert capsys.readouterr().out.splitlines() == [f"wrote {tmp_path / name}" for name in names]


def test_a_picture_of_another_kind_is_bad_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        plot([str(record(tmp_path / "run")), "--output", "curve.gif"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith("--output: curve.gif: the name must end with .png, .svg, .pdf\n")


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")

    def refused(*words: object, output: str = "curve.png") -> str:
        assert plot([*map(str, words), "--output", str(tmp_path / output)]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("daedalus plot: ").replace(str(tmp_path), "TMP")

    run = record(tmp_path / "run")
    assert refused(tmp_path / "nowhere").startswith("TMP/nowhere does not exist: name a run directory")
    assert refused(run, output="no/curve.png") == "TMP/no/curve.png: No such file or directory"
    (run / "metrics.csv").write_text("env_steps,episode_return_mean\n1,2\n")
    assert refused(run) == (
        "TMP/run/metrics.csv has no column entropy: it is not the metrics of a run, or those of an old release"
    )
    assert "entropy" in COLUMNS
