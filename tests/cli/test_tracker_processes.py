"""launch/tracker_processes.py: the real trackers offline, whose files are read back, and trackers that fail or hang."""

import importlib.util
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from log_lines import LINES
from processes import LIMIT, processes_mentioning, until
from recorded_runs import record
from trackers import mlflow_run, trackio_run, wandb_run

from daedalus.launch import tracker_processes
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.tracker_processes import TrackerProcesses
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.metrics_rows import Details

NAMES = ("wandb", "mlflow", "trackio")


@pytest.fixture(autouse=True)
def offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the trackers write into the folder of the test, and know no user and no server."""
    for name in [name for name in os.environ if name.startswith(("WANDB", "MLFLOW", "TRACKIO"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    monkeypatch.setenv("HOME", str(tmp_path))  # no ~/.netrc with a key
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    # The process ends itself a minute after the run, which is too short for one that all others go before.
    monkeypatch.setattr(tracker_processes, "_NICENESS", 0)


def log(
    directory: Path,
    *names: str,
    meanwhile: Callable[[], object] = lambda: None,
    stopping: threading.Event | None = None,
) -> list[str]:
    """Log a run that has ended; return the lines that a user sees."""
    shown: list[str] = []
    with ChildOutput(directory / "output.log", shown.append, shown.append) as output:
        trackers = TrackerProcesses(names, directory, output)
        trackers.start()
        meanwhile()
        trackers.finish(stopping or threading.Event())
    return shown


def read(name: str, tmp_path: Path, directory: Path) -> dict[str, Any]:
    if name == "wandb":
        return wandb_run(directory)
    return mlflow_run(tmp_path / "mlflow.db") if name == "mlflow" else trackio_run(tmp_path / "trackio/daedalus.db")


@pytest.mark.parametrize("name", NAMES)
def test_local_files_have_settings_metrics_and_summary_and_a_resumed_run_keeps_its_id(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(name) if name != "mlflow" else pytest.importorskip("mlflow.version")
    monkeypatch.setattr(tracker_processes, "_FINISH_SECONDS", LIMIT)
    settings = ['environment.kwargs."a*b/c"=3']  # MLflow takes no such name
    directory = record(tmp_path / "run", seed=5, settings=settings, solved=True, evaluation=490.0)
    (shown,) = log(directory, name)
    assert shown.startswith(f"{name}: ")
    run = read(name, tmp_path, directory)
    assert run["id"] in (json.loads((directory / f"tracker-{name}.json").read_text())["id"], *shown.split())
    config = run["config"]
    assert str(config["training.seed"] if name == "mlflow" else config["training"]["seed"]) == "5"
    assert list(run["history"]) == [1000, 2000, 3000]
    assert run["history"][2000]["rollout/episode_return_mean"] == 300.0
    assert run["history"][2000]["time/wall_seconds"] == 120.0
    assert run["summary"]["summary/evaluation_return_mean"] == 490.0
    writer = CsvWriter(directory / "metrics.csv")
    writer.write({"env_steps": 2500, "entropy": 0.5}, Details())  # resumed from a checkpoint
    writer.write({"env_steps": 4000, "entropy": 0.25}, Details())
    writer.close()
    monkeypatch.delenv("WANDB_MODE")
    (shown,) = log(directory, name)
    if name == "wandb":  # nobody is logged in
        assert "`wandb login`" in shown
        assert f"recorded offline; upload the run with: wandb sync {directory}/wandb/offline-run-" in shown
    again = read(name, tmp_path, directory)
    assert again["id"] == run["id"]
    assert again["history"][4000]["train/entropy"] == 0.25
    assert 2500 not in again["history"]
    assert not warnings()


def warnings() -> list[str]:
    return [line for line in LINES if "whole run" in line or "not installed" in line]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Function that puts a package named wandb with this code in front of all others, and returns a run directory."""

    def install(code: str) -> Path:
        (tmp_path / "fake").mkdir()
        (tmp_path / "fake" / "wandb.py").write_text(code)
        monkeypatch.syspath_prepend(tmp_path / "fake")
        inherited = os.environ.get("PYTHONPATH", "")
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(tmp_path / "fake"), inherited])))
        return record(tmp_path / "run")

    return install


HANGS = """
import signal, subprocess, sys
signal.signal(signal.SIGTERM, signal.SIG_IGN)
subprocess.run([sys.executable, "-c", "import time; time.sleep(999)", "helper of DIRECTORY"])
"""


def test_a_tracker_that_hangs_is_ended_with_its_processes_and_reported_once(
    package: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracker_processes, "_FINISH_SECONDS", 0.1)
    directory = package(HANGS.replace("DIRECTORY", str(tmp_path)))
    assert log(directory, "wandb", meanwhile=lambda: until(lambda: processes_mentioning(f"helper of {tmp_path}"))) == []
    assert not (directory / "output.log").exists()  # it has printed nothing
    assert warnings() == [f"wandb has not received the whole run, which is in {directory}"]
    until(lambda: not processes_mentioning(str(tmp_path)))


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("raise ValueError('broken')", "wandb: ValueError: broken; it is tried again"),
        ("import os; os.abort()", ""),
    ],
)
def test_a_tracker_that_fails_is_reported(
    code: str, reason: str, package: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracker_processes, "_FINISH_SECONDS", LIMIT)
    directory = package(code)
    shown = log(directory, "wandb")
    assert [reason in line for line in shown] == ([True] if reason else [])
    assert len(warnings()) == 1


def test_ctrl_c_does_not_wait_for_a_tracker(package: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracker_processes, "_FINISH_SECONDS", 10 * LIMIT)
    directory, stopping = package("import time\nwhile True: time.sleep(1)"), threading.Event()
    stopping.set()
    log(directory, "wandb", stopping=stopping)
    assert len(warnings()) == 1


def test_a_tracker_that_is_not_installed_is_reported_and_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "wandb").mkdir()  # a folder in the working directory is no package
    monkeypatch.syspath_prepend(tmp_path)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "mlflow" else find(name, None))
    assert log(record(tmp_path / "run"), "mlflow") == []
    assert warnings() == [
        "--log mlflow: not installed, and the run goes on without it; "
        "install it with: pip install 'daedalus-rl[mlflow]'"
    ]


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("", "own_writer.py has no 'Writer'"),
        ("import absent_package", "own_writer.py imports absent_package, which is not installed"),
        ("class Writer:\n def __init__(self, run): raise ValueError('no place')", "ValueError: no place"),
    ],
)
def test_a_fault_of_a_writer_of_the_users_is_reported_once(
    code: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own_writer.py").write_text(code)
    (shown,) = log(record(tmp_path / "run"), "own_writer:Writer")
    assert reason in shown
    assert len(warnings()) == 1  # that it has not received the whole run
