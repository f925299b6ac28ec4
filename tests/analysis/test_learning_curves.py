"""Test of analysis/learning_curves.py."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_runs import record

from daedalus.analysis.learning_curves import Series, evaluations, points, series_of
from daedalus.analysis.recorded_run import RETURN, RecordedRun, read_run
from daedalus.analysis.run_groups import Group
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.run.run_directory import METRICS


def run(folder: Path, name: str, **content: Any) -> RecordedRun:
    return read_run(record(folder / name, **content))


def group_curve(*runs: RecordedRun) -> Series | None:
    return series_of(Group(name="group", runs=runs), RETURN, "env_steps")


def test_rows_without_a_value_are_left_out(tmp_path: Path) -> None:
    x, y = points(run(tmp_path, "a", returns=(None, 2.0, 3.0)), RETURN, "env_steps")
    assert (x.tolist(), y.tolist()) == ([2000.0, 3000.0], [2.0, 3.0])
    x, _ = points(run(tmp_path, "b"), RETURN, "minutes")
    assert x.tolist() == [1.0, 2.0, 3.0]


def test_rows_that_were_repeated_from_a_checkpoint_replace_the_earlier_ones(tmp_path: Path) -> None:
    repeated = run(tmp_path, "a", returns=(1.0, 2.0, 3.0, 4.0, 5.0), env_steps=(10, 20, 30, 15, 40))
    x, y = points(repeated, RETURN, "env_steps")
    assert (x.tolist(), y.tolist()) == ([10.0, 15.0, 40.0], [1.0, 4.0, 5.0])


def test_the_curve_is_the_interquartile_mean_at_each_place(tmp_path: Path) -> None:
    runs = [
        run(tmp_path, f"s{seed}", seed=seed, returns=(value, 3.0 * value), env_steps=(0, 100))
        for seed, value in enumerate((-50.0, 1.0, 3.0, 90.0))
    ]
    curve = group_curve(*runs)
    assert curve is not None
    assert curve.low is not None
    assert curve.high is not None
    np.testing.assert_allclose(curve.y, 2.0 + 4.0 * curve.x / 100.0)
    assert np.all(curve.low <= curve.y)
    assert np.all(curve.y <= curve.high)
    assert curve.low[-1] < -1.0


def test_a_finished_run_keeps_its_last_value(tmp_path: Path) -> None:
    short = run(tmp_path, "a", returns=(0.0, 10.0), env_steps=(0, 100))
    long = run(tmp_path, "b", returns=(0.0, 20.0), env_steps=(0, 200))
    curve = group_curve(short, long)
    assert curve is not None
    assert curve.x[-1] == 200.0
    assert curve.y[-1] == 15.0


@pytest.mark.parametrize("evaluation", [None, 3.0])  # a run that was stopped may be evaluated
def test_the_curve_ends_where_an_unfinished_run_ends(tmp_path: Path, evaluation: float | None) -> None:
    running = run(tmp_path, "a", returns=(0.0, 10.0), env_steps=(0, 100), finished=False, evaluation=evaluation)
    curve = group_curve(running, run(tmp_path, "b"))
    assert curve is None  # the other one has its first value at 1,000
    curve = group_curve(running, run(tmp_path, "c", returns=(0.0, 8.0), env_steps=(0, 200)))
    assert curve is not None
    assert curve.x[-1] == 100.0
    assert curve.y[-1] == 7.0


def test_a_run_without_a_value_has_no_curve(tmp_path: Path) -> None:
    assert group_curve(run(tmp_path, "a", returns=(None, None, None)), run(tmp_path, "b")) is None


def test_evaluations_of_an_undone_part_are_left_out_and_the_others_run_forwards(tmp_path: Path) -> None:
    """In the files of earlier releases, which kept the rows that a killed run had made after its checkpoint."""
    directory = record(tmp_path / "run", returns=(1.0,), env_steps=(1000,))
    with closing(CsvWriter(directory / METRICS)) as writer:
        for seconds, steps, at, mean in (
            (120, 2000, 1500, 10.0),
            (180, 3000, 2900, 99.0),  # undone
            (125, 2100, 1900, 20.0),
            (130, 2200, 1800, 15.0),  # of a slower evaluator
        ):
            evaluation = {"evaluation_env_steps": at, "evaluation_return_mean": mean}
            writer.write(
                {"wall_seconds": seconds, "env_steps": steps, "episode_return_mean": 1.0, **evaluation}, Details()
            )
    x, y = evaluations(read_run(directory), "env_steps")
    assert (x.tolist(), y.tolist()) == ([1500, 1800, 1900], [10.0, 15.0, 20.0])
