"""Test of analysis/recorded_run.py."""

import json
import math
from pathlib import Path

import pytest
from recorded_runs import TARGET, record

from daedalus.analysis.recorded_run import SECONDS, read_record, read_run
from daedalus.analysis.run_selection import find_runs
from daedalus.learner.run.run_directory import CONFIG, METRICS, SUMMARY
from daedalus.learner.run.run_files import RunDataError
from daedalus.learner.run.run_lock import RunLock


def refused(directory: Path, *columns: str) -> str:
    with pytest.raises(RunDataError) as error:
        read_run(directory, columns)
    message = str(error.value)
    assert "\n" not in message
    return message.replace(str(directory), "RUN")


class TestThreshold:
    def test_it_is_reached_in_the_first_row_at_least_as_high(self, tmp_path: Path) -> None:
        run = read_run(record(tmp_path / "run", returns=(100.0, 300.0, 480.0)))
        assert run.reached(250.0) == (2000.0, 2.0)
        assert run.reached(300.0) == (2000.0, 2.0)
        assert run.reached(481.0) == (math.inf, math.inf)

    def test_large_and_small_returns_reach_it_exactly(self, tmp_path: Path) -> None:
        for number, threshold in enumerate((1_000_001.0, 1e9 + 1, 2e-5 / 3, -1_000_001.0)):
            below = math.nextafter(threshold, -math.inf)
            run = read_run(record(tmp_path / str(number), returns=(below, below, threshold)))
            assert run.reached(threshold) == (3000.0, 3.0)

    def test_the_mean_of_too_few_episodes_does_not_count(self, tmp_path: Path) -> None:
        run = read_run(record(tmp_path / "run", returns=(480.0, 300.0, 480.0), env_steps=(990, 2000, 3000)))
        assert run.settings["training.target_episodes"] == 100
        assert run.reached(480.0) == (3000.0, 3.0)

    def test_rows_that_a_resumed_run_repeated_do_not_count(self, tmp_path: Path) -> None:
        returns, env_steps = (20.0, 480.0, 20.0, 300.0), (1000, 9000, 2000, 9500)
        run = read_run(record(tmp_path / "run", returns=returns, env_steps=env_steps))
        assert run.reached(475.0) == (math.inf, math.inf)
        assert run.reached(300.0) == (9500.0, 4.0)

    def test_the_target_is_exact_where_the_run_stopped(self, tmp_path: Path) -> None:
        run = read_run(record(tmp_path / "run", solved=True, seconds_to_target=90.0, env_steps=(1000, 2000, 2800)))
        assert run.reached(TARGET) == (2800.0, 1.5)
        assert run.reached(200.0) == (2000.0, 2.0)

    def test_a_run_that_went_on_after_its_target_uses_the_rows(self, tmp_path: Path) -> None:
        settings = ["training.stop_when_solved=false", "training.target_return=300.0"]
        run = read_run(record(tmp_path / "run", settings=settings, solved=True, seconds_to_target=110.0))
        assert run.reached(300.0) == (2000.0, 2.0)


class TestUnfinished:
    def test_a_finished_run_is_not(self, tmp_path: Path) -> None:
        assert read_run(record(tmp_path / "run")).unfinished == ""

    def test_a_learner_without_an_evaluation_is_not(self, tmp_path: Path) -> None:
        run = read_run(record(tmp_path / "run", evaluation=None))
        assert run.unfinished == ""
        assert run.training_return == 480.0

    def test_a_run_without_a_summary_is(self, tmp_path: Path) -> None:
        directory = record(tmp_path / "run", finished=False, evaluation=None)
        assert read_run(directory).unfinished == (
            f"{directory} is not finished (3,000 of 1,500,000 env_steps): continue it with: daedalus resume {directory}"
        )

    def test_the_command_can_be_typed_also_with_a_space_in_the_path(self, tmp_path: Path) -> None:
        directory = record(tmp_path / "my run", finished=False, evaluation=None)
        assert read_run(directory).unfinished.endswith(f"continue it with: daedalus resume '{directory}'")

    def test_a_run_that_is_in_training_is_not_to_be_continued(self, tmp_path: Path) -> None:
        directory = record(tmp_path / "run", finished=False, evaluation=None)
        with RunLock(directory):
            assert read_run(directory).unfinished == (
                f"{directory} is not finished (3,000 of 1,500,000 env_steps): it is still running"
            )

    def test_a_run_that_was_resumed_since_its_summary_is(self, tmp_path: Path) -> None:
        directory = record(tmp_path / "run")
        summary = json.loads((directory / SUMMARY).read_text())
        before = {"env_steps": 2000, "wall_seconds": 120.0, "bottleneck": "none", "rollouts_rejected": {"stale": 3}}
        (directory / SUMMARY).write_text(json.dumps({**summary, **before}))
        run = read_record(directory)
        assert "is not finished" in run.unfinished
        assert (run.number("env_steps"), run.number("wall_seconds")) == (3000.0, 180.0)
        assert (run.bottleneck, run.rejected, run.league) == ("", {}, None)


class TestBadInput:
    def test_paths_that_are_no_runs(self, tmp_path: Path) -> None:
        with pytest.raises(RunDataError, match="does not exist: name a run directory, or a folder of run directories"):
            find_runs([tmp_path / "nowhere"])
        with pytest.raises(RunDataError, match=r"it has neither config\.toml nor metrics\.csv"):
            find_runs([tmp_path])

    def test_a_folder_stands_for_its_runs_once(self, tmp_path: Path) -> None:
        runs = [record(tmp_path / name) for name in ("a", "b")]
        (tmp_path / "other").mkdir()
        roles = [record(tmp_path / "tag" / name) for name in ("adversary", "agent")]
        for hidden in ("a/league", ".tag.restored/agent", "tag/.agent.pruned"):
            record(tmp_path / hidden)
        assert find_runs([runs[1], tmp_path]) == [runs[1], runs[0], *roles]

    def test_a_run_of_several_paths_is_found_once(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        runs = [record(Path("runs") / name) for name in ("a", "b")]
        Path("runs/newest").symlink_to("b")
        assert find_runs([Path("runs")]) == runs
        assert find_runs([Path("runs/newest"), runs[0].resolve(), *runs]) == [Path("runs/newest"), runs[0].resolve()]

    def test_a_run_without_metrics(self, tmp_path: Path) -> None:
        run = record(tmp_path / "run")
        header = (run / METRICS).read_text().splitlines()[0]
        for content in ("", header, f"{header}\n", f"{header}\n1,2"):
            (run / METRICS).write_text(content)
            assert refused(run) == "RUN has no metrics yet: wait until the run has made its first updates"
        (run / METRICS).unlink()
        assert refused(run) == "RUN has no metrics yet: wait until the run has made its first updates"

    def test_a_line_that_is_being_written_is_left_out(self, tmp_path: Path) -> None:
        run = record(tmp_path / "run")
        text = (run / METRICS).read_text()
        (run / METRICS).write_text(text[: text.rindex("3000") + 2])
        assert read_run(run).metrics["env_steps"].tolist() == [1000.0, 2000.0]

    def test_damaged_metrics_are_named_with_their_line(self, tmp_path: Path) -> None:
        run = tmp_path
        (run / METRICS).write_text("env_steps,episode_return_mean\n1,2\nx,3\n4,5\n")
        assert refused(run) == "RUN/metrics.csv is damaged: line 3: could not convert string to float: 'x'"
        (run / METRICS).write_text("env_steps,episode_return_mean\n1,2\n7\n")
        assert refused(run) == "RUN/metrics.csv is damaged: line 3 has 1 cells, and the header has 2"
        (run / METRICS).write_bytes(b"env_steps,episode_return_mean\n1,2\n\xff\xfe,3\n")
        assert "RUN/metrics.csv is damaged: 'utf-8' codec" in refused(run)

    def test_metrics_of_an_old_release_name_the_missing_column(self, tmp_path: Path) -> None:
        (tmp_path / METRICS).write_text("env_steps,episode_return_mean\n1,2\n")
        expected = (
            "RUN/metrics.csv has no column wall_seconds: it is not the metrics of a run, or those of an old release"
        )
        assert refused(tmp_path, SECONDS) == expected

    def test_damaged_settings_and_summaries(self, tmp_path: Path) -> None:
        run = record(tmp_path / "run")
        (run / SUMMARY).write_text("{")
        assert refused(run) == "RUN/summary.json is damaged: it is not valid JSON; delete the file"
        (run / SUMMARY).write_text("[]")
        assert refused(run) == "RUN/summary.json is damaged: it is not a JSON object; delete the file"
        (run / CONFIG).write_text("[training")
        assert "RUN/config.toml is not valid TOML: " in refused(run)

    def test_summary_without_steps_is_that_of_the_last_row(self, tmp_path: Path) -> None:
        directory = record(tmp_path / "run", solved=True, seconds_to_target=90.0)
        summary = json.loads((directory / SUMMARY).read_text())
        for changed in ({**summary, "env_steps": None}, {k: v for k, v in summary.items() if k != "env_steps"}):
            (directory / SUMMARY).write_text(json.dumps(changed))
            run = read_run(directory)
            assert run.unfinished == ""
            assert run.reached(TARGET) == (3000.0, 3.0)

    def test_environment_that_is_no_text_is_left_out(self, tmp_path: Path) -> None:
        run = record(tmp_path / "run")
        (run / CONFIG).write_text("[environment]\nid = []\n")
        assert read_run(run).settings == {}

    def test_settings_of_another_release_are_read_as_they_are(self, tmp_path: Path) -> None:
        run = record(tmp_path / "run")
        (run / CONFIG).write_text("[training]\ntarget_return = 1.0\nforgotten_setting = 3\n")
        assert read_run(run).settings == {"training.target_return": 1.0, "training.forgotten_setting": 3}
