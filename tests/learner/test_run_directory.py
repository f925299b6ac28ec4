"""The run directory: its files, and its lock."""

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from building import run_spec
from hypothesis import given
from hypothesis import strategies as st
from processes import LIMIT

from daedalus.learner.run import run_directory, run_lock
from daedalus.learner.run.run_lock import LOCK, RunInUseError, RunLock, is_locked
from daedalus.learner.run.settings import SettingsError, read_preset
from daedalus.learner.run.settings import run_spec as run_spec_of
from daedalus.policy.saving.sealed import write_sealed
from daedalus.protocol.spec import RunSpec

FINITE = st.floats(allow_nan=False, allow_infinity=False)
ABOVE_0 = st.floats(0.0, 1e9, exclude_min=True)
UNIT = st.floats(0.0, 1.0)
JSON = st.recursive(
    st.booleans() | st.integers(-(2**60), 2**60) | FINITE | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@st.composite
def specs(draw: st.DrawFn) -> RunSpec:
    def some(**strategies: st.SearchStrategy[Any]) -> dict[str, Any]:
        """Draw any subset of the settings; the others have their defaults."""
        return draw(st.fixed_dictionaries({}, optional=strategies))

    return RunSpec.model_validate(
        {
            "environment": {
                "id": draw(st.from_regex(r"[^\W:]{1,9}|[^\W\d]{1,5}:[\w' -]{1,5}", fullmatch=True)),
                **some(
                    kwargs=st.dictionaries(st.text(max_size=5), JSON, max_size=3),
                    max_episode_steps=st.integers(1, 10**9),
                    reward_scale=ABOVE_0,
                ),
            },
            "policy": some(hidden=st.lists(st.integers(1, 999), min_size=1, max_size=8)),
            "collection": some(actors=st.integers(1, 99), window=st.integers(1, 64)),
            "training": some(
                algorithm=st.sampled_from(["a2c", "a3c", "impala"]),
                target_return=FINITE,
                learning_rate=st.floats(0.0, 1.0, exclude_min=True),
                learning_rate_final=UNIT,
                entropy_bonus_final=UNIT,
                optimizer_epsilon=ABOVE_0,
                stop_when_solved=st.booleans(),
            ),
            "service": some(log_seconds=ABOVE_0),
        }
    )


@given(specs())
def test_config_toml_reads_back_as_the_same_run(tmp_path_factory: pytest.TempPathFactory, spec: RunSpec) -> None:
    directory = tmp_path_factory.mktemp("run")
    run_directory.write_config(directory, spec)
    assert run_directory.read_config(directory) == spec


def test_config_toml_contains_defaults_and_can_be_used_as_a_preset(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"is not a run directory: it has no config\.toml"):
        run_directory.read_config(tmp_path)
    run_directory.create(tmp_path, run_spec(algorithm="a3c", seed=9))
    path = tmp_path / run_directory.CONFIG
    assert "discount_factor = 0.99" in path.read_text()
    assert run_spec_of(read_preset(str(path))) == run_spec(algorithm="a3c", seed=9)


def test_new_run_directory_contains_config_and_versions(tmp_path: Path) -> None:
    run_directory.create(tmp_path / "runs" / "new", run_spec())
    assert sorted(entry.name for entry in (tmp_path / "runs" / "new").iterdir()) == [
        *("config.toml", "learner.lock", "versions.json")
    ]
    versions = run_directory.read_json(tmp_path / "runs" / "new" / run_directory.VERSIONS)
    assert {"python", "torch", "numpy", "eclipse-zenoh"} <= versions.keys()


@pytest.mark.skipif(sys.platform == "win32", reason="no permissions")
def test_only_its_owner_may_enter_a_new_run_directory(tmp_path: Path) -> None:
    for numbered in (False, True):
        run_directory.create_locked(tmp_path / "runs" / str(numbered), run_spec(), numbered=numbered).close()
        assert (tmp_path / "runs" / str(numbered)).stat().st_mode & 0o777 == 0o700
    with run_directory.made(tmp_path / "runs" / "made"):
        assert (tmp_path / "runs" / "made").stat().st_mode & 0o777 == 0o700
    (tmp_path / "mine").mkdir(0o755)
    run_directory.create_locked(tmp_path / "mine", run_spec()).close()
    assert (tmp_path / "mine").stat().st_mode & 0o777 == 0o755  # a directory of the user's stays as it is


def test_empty_directory_is_accepted_and_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    run_directory.create(tmp_path / "empty", run_spec())
    (tmp_path / "file").touch()
    with pytest.raises(SettingsError, match=r"file is a file: choose a directory with --run-dir"):
        run_directory.create(tmp_path / "file", run_spec())
    with pytest.raises(SettingsError, match=r"is not empty, and has no config\.toml: choose another directory"):
        run_directory.create(tmp_path, run_spec())
    with pytest.raises(SettingsError, match="Not a directory"):
        run_directory.create(tmp_path / "file" / "run", run_spec())


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "setting environment is missing"),
        ("[environment]\nid = 3", "setting environment.id"),
        ("a = " + "[" * 50_000, "is not valid: its values are nested too deeply"),
        ("a." * 8000 + "a = 1", "is not valid: its values are nested too deeply"),
        ("a = " + "9" * 5000, "is not valid TOML"),
        ("#" * ((1 << 20) + 1), "is larger than 1 MiB"),
    ],
)
def test_damaged_config_toml_is_named(tmp_path: Path, text: str, reason: str) -> None:
    """A sweep has many of them."""
    path = tmp_path / run_directory.CONFIG
    path.write_text(text)
    with pytest.raises(SettingsError) as error:
        run_directory.read_config(tmp_path)
    assert str(error.value).startswith(str(path))
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


def test_json_reads_back_and_damage_raises(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    run_directory.write_json(path, {"solved": True, "seconds": 1.5})
    assert run_directory.read_json(path) == {"solved": True, "seconds": 1.5}
    for damaged in (path.read_text()[:9], "", "[]", "[" * 200_000, '{"a": ' + "9" * 5000 + "}"):
        path.write_text(damaged)
        with pytest.raises(SettingsError, match="is damaged"):
            run_directory.read_json(path)
    with pytest.raises(SettingsError, match="does not exist"):
        run_directory.read_json(tmp_path / "none.json")


def test_json_file_is_unchanged_when_its_replacement_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "summary.json"
    run_directory.write_json(path, {"run": 1})

    def refuse(*_: object) -> None:
        raise OSError("the power failed")

    monkeypatch.setattr("daedalus.learner.run.run_directory.os.replace", refuse)
    with pytest.raises(OSError, match="power"):
        run_directory.write_json(path, {"run": 2})
    assert json.loads(path.read_text()) == {"run": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_settings_that_cannot_be_written_are_named_and_leave_the_former_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_directory.write_config(tmp_path, run_spec(seed=1))

    def disk_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")  # without a file name, as of a write

    monkeypatch.setattr(Path, "write_text", disk_full)
    with pytest.raises(SettingsError, match=r"^.*/config\.toml cannot be written: No space left on device$"):
        run_directory.write_config(tmp_path, run_spec(seed=2))
    assert run_directory.read_config(tmp_path) == run_spec(seed=1)
    assert [file.name for file in tmp_path.iterdir()] == [run_directory.CONFIG]


def test_name_of_a_run_is_that_of_its_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = tmp_path / "try-1"
    directory.mkdir()
    monkeypatch.chdir(directory)
    assert {
        run_directory.run_name(path) for path in (directory, Path(), Path("../try-1"), directory / "checkpoints" / "..")
    } == {"try-1"}
    (tmp_path / "current").symlink_to(directory)
    assert run_directory.run_name(tmp_path / "current") == "current"
    assert run_directory.run_name(tmp_path / "try#1") != run_directory.run_name(tmp_path / "try 1")


def test_default_directory_is_named_after_the_run() -> None:
    directory = run_directory.default_directory("ALE/Pong-v5", run_spec(algorithm="a3c", seed=4))
    assert directory.parent == Path("runs")
    assert directory.name.startswith("ALE-Pong-v5-a3c-s4-")


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_lock, "_ENDING_SECONDS", 0.0)


def test_a_second_lock_is_refused_with_the_holder_until_the_first_is_closed(tmp_path: Path) -> None:
    with RunLock(tmp_path), pytest.raises(RunInUseError) as refused:
        RunLock(tmp_path)
    assert str(refused.value) == (
        f"run directory {tmp_path} is in use by process {os.getpid()} on {socket.gethostname()}: "
        "stop it first, or choose another directory"
    )
    RunLock(tmp_path).close()


@pytest.mark.parametrize("name", [LOCK, "metrics.csv", "events.jsonl", "checkpoints", "0"])
def test_received_directory_with_links_is_refused_before_anything_is_written(tmp_path: Path, name: str) -> None:
    victim, run = tmp_path / "victim", tmp_path / "run"
    run.mkdir()
    victim.write_text("precious")
    (run / name).symlink_to(victim)
    with pytest.raises(SettingsError, match=rf"run directory .*/run: {name} is a link: remove it, or copy the"):
        RunLock(run)
    assert victim.read_text() == "precious"
    assert os.listdir(run) == [name]
    linked = tmp_path / "linked"  # the run directory itself may be a link
    (run / name).unlink()
    linked.symlink_to(run)
    RunLock(linked).close()


def test_whether_a_run_is_locked_can_be_asked(tmp_path: Path) -> None:
    assert not is_locked(tmp_path)
    with RunLock(tmp_path):
        assert is_locked(tmp_path)
    assert not is_locked(tmp_path)
    (tmp_path / LOCK).unlink()
    os.mkfifo(tmp_path / LOCK)
    assert not is_locked(tmp_path)  # and it returns


def test_a_child_process_holds_the_lock_until_it_is_killed(tmp_path: Path) -> None:
    lock = RunLock(tmp_path)
    words = [sys.executable, "-S", "-c", "import time; time.sleep(1000)"]
    with subprocess.Popen(words, pass_fds=lock.inheritable) as child:
        lock.close()
        with pytest.raises(RunInUseError):
            RunLock(tmp_path)
        child.kill()
        child.wait(LIMIT)
        RunLock(tmp_path).close()


def test_after_the_launcher_was_killed_its_learner_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_lock, "_LEAVING_SECONDS", LIMIT)
    learner = "import time; time.sleep(1000)"
    launcher = (
        "import subprocess, sys, time; from pathlib import Path; from daedalus.learner.run.run_lock import RunLock\n"
        f"lock = RunLock(Path({str(tmp_path)!r}))\n"
        f"child = subprocess.Popen([sys.executable, '-S', '-c', {learner!r}], pass_fds=lock.inheritable, stdout=-3)\n"
        "print(child.pid, flush=True); time.sleep(1000)"
    )
    with subprocess.Popen([sys.executable, "-c", launcher], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        process.kill()
    waiting = threading.Timer(0.3, os.kill, (child, signal.SIGKILL))
    waiting.start()
    RunLock(tmp_path).close()
    waiting.join()


def test_a_holder_on_another_host_is_taken_to_run(tmp_path: Path) -> None:
    with RunLock(tmp_path):
        (tmp_path / LOCK).write_text("1 other-host.lan\n")
        with pytest.raises(RunInUseError, match=r"in use by process 1 on other-host.lan"):
            RunLock(tmp_path)
        (tmp_path / LOCK).write_text("1 \x1b[31mhost\n")
        with pytest.raises(RunInUseError, match="in use by another process"):
            RunLock(tmp_path)


def test_a_file_system_without_locks_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def unsupported(_descriptor: int, _operation: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    assert run_lock.fcntl is not None
    monkeypatch.setattr(run_lock.fcntl, "flock", unsupported)
    RunLock(tmp_path).close()
    assert caplog.messages == [
        f"the file system of {tmp_path} has no locks: start no second learner in this run directory"
    ]


def test_a_directory_that_was_removed_meanwhile_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RunLock, "_try", lambda lock: (tmp_path / LOCK).unlink() is None)
    with pytest.raises(RunInUseError, match="was removed by another process"):
        RunLock(tmp_path)
    with pytest.raises(SettingsError, match="No such file"):
        RunLock(tmp_path / "nowhere")


def test_a_new_run_is_locked_and_a_second_one_leaves_it_as_it_is(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    with run_directory.create_locked(directory, run_spec(seed=1)):
        with pytest.raises(RunInUseError):
            RunLock(directory)
        with pytest.raises(SettingsError, match="exists: continue the run"):
            run_directory.create_locked(directory, run_spec(seed=2))
    (tmp_path / "begun").mkdir()
    with RunLock(tmp_path / "begun"), pytest.raises(RunInUseError):  # the first one has written nothing yet
        run_directory.create_locked(tmp_path / "begun", run_spec(seed=2))
    assert run_directory.read_config(directory).training.seed == 1


def test_default_names_of_the_same_second_get_numbers(tmp_path: Path) -> None:
    locks = [run_directory.create_locked(tmp_path / "runs" / "name", run_spec(), numbered=True) for _ in range(3)]
    assert [lock.directory.name for lock in locks] == ["name", "name-2", "name-3"]
    for lock in locks:
        lock.close()


def test_a_failed_start_leaves_no_run_directory_but_the_files_of_others(tmp_path: Path) -> None:
    for name in ("failed", "other", "trained"):
        run_directory.create(tmp_path / name, run_spec())
        (tmp_path / name / "output.log.1").touch()
        (tmp_path / name / "checkpoints").mkdir()
        write_sealed(tmp_path / name / "league" / "opponent_1", {}, {})
    (tmp_path / "other" / "notes.txt").touch()
    (tmp_path / "trained" / "checkpoints" / "0000000001").mkdir()
    for name in ("failed", "other", "trained"):
        run_directory.remove_failed(tmp_path / name)
    assert not (tmp_path / "failed").exists()
    assert [entry.name for entry in (tmp_path / "other").iterdir()] == ["notes.txt"]
    assert (tmp_path / "trained" / "config.toml").exists()
