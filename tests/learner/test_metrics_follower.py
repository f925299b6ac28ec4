"""learner/reporting/trackers/metrics_follower.py: every complete row of a growing metrics.csv, once."""

from pathlib import Path

from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.metrics import Details
from daedalus.learner.reporting.trackers.metrics_follower import MetricsFollower


def steps(follower: MetricsFollower) -> list[float]:
    return [row["env_steps"] for row in follower.rows()]


def test_each_row_is_read_once_also_after_the_file_is_written_anew(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    follower = MetricsFollower(path)
    assert steps(follower) == []
    writer = CsvWriter(path)
    writer.write({"env_steps": 1}, Details())
    writer.write({"env_steps": 2}, Details())
    assert steps(follower) == [1, 2]
    writer.write({"env_steps": 3, "env/lives": 5.0}, Details())  # a new column
    writer.write({"env_steps": 4, "env/lives": 4.0}, Details())
    assert list(follower.rows()) == [{"env_steps": 3, "env/lives": 5}, {"env_steps": 4, "env/lives": 4}]
    assert steps(follower) == []
    writer.close()
    assert steps(MetricsFollower(path, follower.taken - 1)) == [4]


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
    assert follower.taken == 1
    assert steps(follower) == [20, 30]


def test_a_damaged_row_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"env_steps,entropy\n10,nan\n\xff\x00,1\n\n30,x,7\n")
    assert list(MetricsFollower(path).rows()) == [{"env_steps": 10}, {}, {}, {"env_steps": 30}]
