"""Metrics writers: the files are readable by csv and by TensorBoard."""

import csv
import errno
import tracemalloc
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer.record_writer import RecordWriter

from daedalus.learner.reporting import thinning
from daedalus.learner.reporting.csv_writer import CsvWriter, cut_rows
from daedalus.learner.reporting.metrics_rows import COLUMNS, Details, read_rows, tag
from daedalus.learner.reporting.tensorboard_writer import TensorBoardWriter
from daedalus.learner.training.update_metrics import METRICS

NONE = Details()


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, *rows: dict[str, float]) -> None:
    """Write rows by a new writer of the CSV file."""
    with closing(CsvWriter(path)) as writer:
        for row in rows:
            writer.write(row, NONE)


def events_of(folder: Path, *rows: tuple[dict[str, float], Details]) -> EventAccumulator:
    """Return what TensorBoard reads after these rows."""
    with closing(TensorBoardWriter(folder)) as writer:
        for row, details in rows:
            writer.write(row, details)
    return EventAccumulator(str(folder)).Reload()


def test_csv_has_a_header_and_a_line_for_each_row_with_blank_unknown_values(tmp_path: Path) -> None:
    writer = CsvWriter(tmp_path / "metrics.csv")
    writer.write({"env_steps": 12_345_678, "wall_seconds": 1.23456789, "policy_loss": -1e-9}, NONE)
    (row,) = read(tmp_path / "metrics.csv")  # the line is on disk before the writer is closed
    writer.close()
    assert tuple(row) == COLUMNS
    known = {name: text for name, text in row.items() if text}
    assert known == {"env_steps": "12345678", "wall_seconds": "1.23456789", "policy_loss": "-1e-09"}


@pytest.mark.parametrize(
    "value", [1_000_001.0, 1234567.0, 16_777_217.0, 1e9 + 1, 2e-5 / 3, 1e-9, -0.1, 1e22, np.float64(1 / 3), 2**53 - 1]
)
def test_numbers_are_exact_in_the_csv(tmp_path: Path, value: float) -> None:
    row = {"env_steps": 2**33 + 1, "user/score": value, "episode_return_mean": value}
    write(tmp_path / "metrics.csv", row)
    assert list(read_rows(tmp_path / "metrics.csv")) == [row]


def test_rows_after_the_checkpoint_are_cut_and_those_that_an_earlier_release_left(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    with closing(CsvWriter(path)) as writer:
        for seconds, env_steps in ((1, 10), (2, 90), (3, 95), (2.5, 97), (4, 20), (5, 30), (6, 40), (7, 50)):
            writer.write({"wall_seconds": seconds, "env_steps": env_steps, "user/score": 2.0}, NONE)
    assert [row["env_steps"] for row in cut_rows(path, 45)] == [50]
    assert [row["env_steps"] for row in read_rows(path)] == [10, 20, 30, 40]
    before = path.read_bytes()
    assert cut_rows(path, 45) == cut_rows(tmp_path / "none.csv", 45) == []
    assert path.read_bytes() == before


def test_tensorboard_forgets_what_a_resumed_run_has_undone(tmp_path: Path) -> None:
    for first, rows in ((None, (10, 20, 30)), (20, (25, 30))):
        with closing(TensorBoardWriter(tmp_path)) as writer:
            if first is not None:
                writer.purge(first)
            for env_steps in rows:
                writer.write({"env_steps": env_steps, "entropy": env_steps + (first or 0)}, NONE)
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(each.step, each.value) for each in events.Scalars("train/entropy")] == [
        *((10, 10), (20, 20), (25, 45), (30, 50)),
    ]


def test_csv_continues_with_the_columns_of_an_existing_header_and_adds_new_ones(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("wall_seconds,policy_loss,env_steps,no_longer_measured\r\n0.5,0.25,10,7\r\n")
    write(
        path,
        {"env_steps": 15, "policy_loss": 0.5},
        {"env_steps": 20, "clipped_fraction": 0.1, "policy_loss": -1.5, "wall_seconds": 1.5},
        {"env_steps": 30, "env/laps": 2.0},
    )
    names = ("wall_seconds", "policy_loss", "env_steps", "no_longer_measured", "clipped_fraction", "env/laps")
    assert read(path) == [
        dict(zip(names, ("0.5", "0.25", "10", "7", "", ""), strict=True)),
        dict(zip(names, ("", "0.5", "15", "", "", ""), strict=True)),
        dict(zip(names, ("1.5", "-1.5", "20", "", "0.1", ""), strict=True)),
        dict(zip(names, ("", "", "30", "", "", "2"), strict=True)),
    ]
    assert sorted(tmp_path.iterdir()) == [path]


def test_csv_that_cannot_be_written_anew_keeps_its_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "metrics.csv"
    writer = CsvWriter(path)
    writer.write({"env_steps": 1}, NONE)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space left"):
        writer.write({"env_steps": 2, "env/laps": 2.0}, NONE)
    writer.close()
    assert [row["env_steps"] for row in read(path)] == ["1"]
    assert sorted(tmp_path.iterdir()) == [path]


def test_csv_continues_a_file_whose_header_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"wall_seconds,env_\xffsteps\r\n1,2\r\n")
    write(path, {"wall_seconds": 2.0, "env_steps": 5})
    assert read(path) == [
        {"wall_seconds": "1", "env_\ufffdsteps": "2", "env_steps": ""},
        {"wall_seconds": "2", "env_\ufffdsteps": "", "env_steps": "5"},
    ]


@pytest.mark.parametrize("header", [b"", b"env_steps\r\n"])
def test_csv_without_rows_raises_os_error_that_says_what_to_do(tmp_path: Path, header: bytes) -> None:
    """The recorder then logs it, and training continues."""
    path = tmp_path / "metrics.csv"
    path.write_bytes(header + b'"' + b"x" * 200_000 + b"\n")
    with pytest.raises(OSError, match=r"metrics\.csv is damaged \(field larger .*\): move it away"):
        write(path, {"env_steps": 1, "env/laps": 2.0})
    with pytest.raises(OSError, match="Is a directory"):
        CsvWriter(tmp_path)


@pytest.mark.parametrize("partial", [b"", b"3", b"3,4", b"3,4\r", b"7" * 150_000])
def test_csv_continues_after_the_part_of_a_line_that_a_crash_left(tmp_path: Path, partial: bytes) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"wall_seconds,env_steps\r\n1,2\r\n" + partial)
    write(path, {"wall_seconds": 5.0, "env_steps": 6})
    assert path.read_bytes() == b"wall_seconds,env_steps\r\n1,2\r\n5,6\r\n"


@pytest.mark.parametrize("part", [b"", b"wall_sec"])
def test_csv_writes_its_header_anew_after_a_part_of_it(tmp_path: Path, part: bytes) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(part)
    write(path)
    assert path.read_text().strip() == ",".join(COLUMNS)


MONTH = 30 * 86_400


def test_the_files_of_a_month_are_bounded_and_lose_nothing_in_aggregate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thinning, "MAX_BYTES", most := 1 << 17)
    path, count = tmp_path / "metrics.csv", 8000
    generator = np.random.default_rng(1)
    rows = [
        {
            "wall_seconds": MONTH * number / count,
            "env_steps": 640 * number,
            "updates": 5 * number + int(generator.integers(5)),
            "episodes": 3 * number,
            "entropy": generator.random(),
            "episode_return_mean": generator.random(),
        }
        for number in range(1, count + 1)
    ]
    with closing(CsvWriter(path)) as writer, closing(TensorBoardWriter(tmp_path)) as events:
        for row in rows:
            writer.write(row, NONE)
            events.write(row, NONE)
            assert path.stat().st_size <= most
    kept = list(read_rows(path))
    assert kept[-300:] == rows[-300:]  # the newest are as they were
    by_steps = {row["env_steps"]: row for row in rows}
    newest = ("wall_seconds", "updates", "episodes", "episode_return_mean")  # counters, and statistics at the time
    assert all(row[name] == by_steps[row["env_steps"]][name] for row in kept for name in newest)
    gaps = np.diff([row["env_steps"] for row in kept])
    assert np.ptp(gaps[:100]) <= 640  # even

    def mean(of: list[dict[str, float]]) -> float:
        """Return the mean entropy of all updates."""
        return float(np.average([row["entropy"] for row in of], weights=np.diff([0, *(row["updates"] for row in of)])))

    assert mean(kept) == pytest.approx(mean(rows), abs=1e-12)
    entropy = EventAccumulator(str(tmp_path), {"scalars": 0}).Reload().Scalars("train/entropy")
    assert 3000 < len(entropy) < 5000
    assert (entropy[0].step, entropy[-1].step) == (640, 640 * count)


def test_what_crashes_while_old_rows_are_merged_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "MAX_BYTES", 5000)
    path, rows = tmp_path / "metrics.csv", [{"env_steps": step, "user/score": 1.5} for step in range(1000, 1150)]

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as failing, closing(CsvWriter(path)) as writer:
        for index, row in enumerate(rows):
            writer.write(row, NONE)
            if not index:  # which had a new column
                failing.setattr("os.replace", full)
    assert list(read_rows(path)) == rows
    (tmp_path / ".metrics.csv.1.partial").write_text("env_steps")  # a learner was killed while it wrote this
    write(path, {"env_steps": 1150, "user/score": 2.5})
    kept = list(read_rows(path))
    assert kept[-20:] == [*rows[-19:], {"env_steps": 1150, "user/score": 2.5}]
    assert len(kept) <= 75
    assert sorted(tmp_path.iterdir()) == [path]


def test_a_run_that_continues_bounds_the_file_of_an_earlier_release(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "metrics.csv"
    write(path, *({"env_steps": step, "wall_seconds": step / 10} for step in range(1000)))
    monkeypatch.setattr(thinning, "MAX_BYTES", 6000)
    assert [row["env_steps"] for row in cut_rows(path, 997)] == [998, 999]
    assert path.stat().st_size <= 6000
    assert [row["env_steps"] for row in read_rows(path)][-10:] == [*range(988, 998)]


def test_tensorboard_scalars_are_against_env_steps(tmp_path: Path) -> None:
    rows = {"env_steps": 100, "policy_loss": 0.5, "updates": 3}, {"env_steps": 250, "policy_loss": -1.5}
    events = events_of(tmp_path, *((row, NONE) for row in rows))
    assert sorted(events.Tags()["scalars"]) == ["time/updates", "train/policy_loss"]
    assert [(scalar.step, scalar.value) for scalar in events.Scalars("train/policy_loss")] == [(100, 0.5), (250, -1.5)]
    assert [(scalar.step, scalar.value) for scalar in events.Scalars("time/updates")] == [(100, 3.0)]


def test_tensorboard_leaves_no_file_behind_that_it_cannot_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flush(_writer: RecordWriter) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RecordWriter, "flush", flush)
    with pytest.raises(OSError, match="No space"):
        TensorBoardWriter(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_every_tag_is_in_a_group() -> None:
    assert tag("evaluation_return_mean") == "evaluation/return_mean"
    assert tag("rollouts_accepted") == "rollout/rollouts_accepted"
    assert tag("env/laps") == "env/laps"
    assert {name: tag(name).count("/") for name in COLUMNS} == dict.fromkeys(COLUMNS, 1)
    assert len({tag(name) for name in COLUMNS}) == len(set(COLUMNS)) == len(COLUMNS)
    assert set(METRICS) <= set(COLUMNS)


def test_tensorboard_contains_histograms_and_the_observation_image(tmp_path: Path) -> None:
    picture = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    details = Details(returns=[1.0, 1.0, 5.0], lengths=[3, 4, 4], action_counts={"action": [2, 0, 5]}, picture=picture)
    no_new_values = Details(action_counts={"action": [0, 0, 0]})
    events = events_of(tmp_path, ({"env_steps": 100}, details), ({"env_steps": 200}, no_new_values))
    assert sorted(events.Tags()["histograms"]) == [
        "rollout/action",
        "rollout/episode_length",
        "rollout/episode_return",
    ]
    (returns,) = events.Histograms("rollout/episode_return")
    assert (returns.step, returns.histogram_value.num, returns.histogram_value.sum) == (100, 3.0, 7.0)
    assert (returns.histogram_value.min, returns.histogram_value.max) == (1.0, 5.0)
    actions = events.Histograms("rollout/action")[0].histogram_value
    assert actions.bucket == [2.0, 0.0, 5.0]
    assert (actions.min, actions.max, actions.num, actions.sum, actions.sum_squares) == (0.0, 2.0, 7.0, 10.0, 20.0)
    (image,) = events.Images("rollout/observation")
    assert (image.step, image.width, image.height) == (100, 8, 6)


LARGEST = float(np.finfo(np.float32).max)  # returns are float32 on the wire


@pytest.mark.parametrize(
    "returns",
    [
        [3e14, 3e14],
        [LARGEST, LARGEST],
        [-LARGEST, LARGEST],
        [1e-30, 1e-30],
        [0.0, 0.0],
        [1e15, float(np.nextafter(np.float32(1e15), np.float32(2e15)))],
        [1e-8, 3e-8],
    ],
)
def test_tensorboard_has_a_histogram_of_equal_and_of_very_large_returns(tmp_path: Path, returns: list[float]) -> None:
    events = events_of(tmp_path, ({"env_steps": 1}, Details(returns=returns, lengths=[1, 1])))
    (found,) = events.Histograms("rollout/episode_return")
    histogram = found.histogram_value
    assert (histogram.min, histogram.max, sum(histogram.bucket)) == (min(returns), max(returns), 2.0)
    assert (np.diff(histogram.bucket_limit) > 0.0).all()
    assert np.count_nonzero(histogram.bucket) == len(set(returns))


def test_neighbouring_choices_share_a_bucket_where_there_are_many(tmp_path: Path) -> None:
    choices = 4672  # of chess: 19 in a bucket
    events = events_of(tmp_path, ({"env_steps": 1}, Details(action_counts={"action": [1] * (choices - 1) + [5]})))
    (found,) = events.Histograms("rollout/action")
    buckets, limits = found.histogram_value.bucket, found.histogram_value.bucket_limit
    assert (buckets[:-1], buckets[-1]) == ([19.0] * 245, 17.0 + 4.0)
    assert limits == [*np.arange(19, choices, 19) - 0.5, choices - 0.5]


def test_histogram_of_actions_takes_no_memory_for_each_action(tmp_path: Path) -> None:
    writer = TensorBoardWriter(tmp_path)
    tracemalloc.start()
    try:
        writer.write({"env_steps": 1}, Details(action_counts={"action": [0, 1_000_000, 1_000_000]}))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        writer.close()
    assert peak < 1 << 20
