"""learner/run/run_lock.py: one learner at a time in a run directory."""

import errno
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from building import run_spec
from processes import LIMIT

from daedalus.learner.run import run_directory, run_lock
from daedalus.learner.run.run_lock import LOCK, RunInUseError, RunLock, is_locked
from daedalus.learner.run.settings import SettingsError


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_lock, "_ENDING_SECONDS", 0.0)


def test_a_second_lock_is_refused_with_the_holder_until_the_first_is_closed(tmp_path: Path) -> None:
    with RunLock(tmp_path), pytest.raises(RunInUseError) as refused:
        RunLock(tmp_path)
    assert str(refused.value) == (
        f"run directory {tmp_path} is in use by process {os.getpid()} on {socket.gethostname()}: "
        "stop it first, or choose another --run-dir"
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
    (tmp_path / "other" / "notes.txt").touch()
    (tmp_path / "trained" / "checkpoints" / "0000000001").mkdir()
    for name in ("failed", "other", "trained"):
        run_directory.remove_failed(tmp_path / name)
    assert not (tmp_path / "failed").exists()
    assert [entry.name for entry in (tmp_path / "other").iterdir()] == ["notes.txt"]
    assert (tmp_path / "trained" / "config.toml").exists()
