"""learner/reporting/trackers/tracking.py: every complete row of a growing metrics.csv."""

from pathlib import Path

from daedalus.learner.reporting.csv_writer import CsvWriter, cut_rows
from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.trackers.tracking import MetricsFollower


def steps(follower: MetricsFollower) -> list[float]:
    return [row["env_steps"] for row in follower.rows()]


def test_each_row_is_read_once_until_the_file_is_written_anew(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    follower = MetricsFollower(path)
    assert steps(follower) == []
    writer = CsvWriter(path)
    writer.write({"env_steps": 1}, Details())
    writer.write({"env_steps": 2}, Details())
    assert steps(follower) == [1, 2]
    writer.write({"env_steps": 3, "env/lives": 5.0}, Details())  # a new column
    writer.write({"env_steps": 4, "env/lives": 4.0}, Details())
    assert list(follower.rows())[2:] == [{"env_steps": 3, "env/lives": 5}, {"env_steps": 4, "env/lives": 4}]
    assert steps(follower) == []
    writer.close()


def test_rows_that_a_resumed_run_makes_again_are_read_after_those_that_it_cut(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    writer = CsvWriter(path)
    for env_steps in (1000, 2000, 3000, 4000):
        writer.write({"env_steps": env_steps}, Details())
    writer.close()
    follower = MetricsFollower(path)
    assert steps(follower) == [1000, 2000, 3000, 4000]
    assert [row["env_steps"] for row in cut_rows(path, 2500)] == [3000, 4000]
    assert steps(follower) == [1000, 2000]
    writer = CsvWriter(path)
    writer.write({"env_steps": 2600}, Details())
    assert steps(follower) == [2600]
    writer.write({"env_steps": 3700, "env/laps": 1.0}, Details())
    assert steps(follower) == [1000, 2000, 2600, 3700]
    writer.close()


def test_an_incomplete_row_is_read_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"env_steps,entropy\r\n10,0.5\r\n20,0.")
    follower = MetricsFollower(path)
    assert steps(follower) == [10]
    with open(path, "ab") as file:
        file.write(b"25\r\n")
    assert list(follower.rows()) == [{"env_steps": 20, "entropy": 0.25}]


def test_a_row_whose_use_failed_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"env_steps\n10\n20\n30\n")
    follower = MetricsFollower(path)

    rows = follower.rows()
    assert [next(rows)["env_steps"], next(rows)["env_steps"]] == [10, 20]  # the use of row 20 does not end
    assert steps(follower) == [20, 30]


def test_a_damaged_row_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"env_steps,entropy\n10,nan\n\xff\x00,1\n\n30,x,7\n")
    assert list(MetricsFollower(path).rows()) == [{"env_steps": 10}, {}, {}, {"env_steps": 30}]
