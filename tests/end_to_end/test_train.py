"""Test of `daedalus train` and `daedalus resume`, with real processes. An audit hook ends one that unpickles."""

import csv
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from processes import (
    ENDLESS,
    PLAYING_SLOW,
    SLOW,
    Running,
    is_nothing_left,
    listening_ports,
    processes_mentioning,
    starting,
    until,
)
from trackers import wandb_run

from daedalus.launch.evaluation import evaluate
from daedalus.learner.run.run_lock import RunInUseError, RunLock
from daedalus.learner.serving.events import read_events

Start = Callable[..., Running]
TARGET, EPISODES = 120, 40  # mean return of so many episodes; an untrained policy has about 20
SHORT = ("--set", "collection.envs_per_actor=2", "--set", "evaluation.final_episodes=0")


@pytest.fixture(scope="module", autouse=True)
def audit_hook() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent.parent / "audit"))
        yield


def test_the_audit_hook_ends_a_process_that_unpickles() -> None:
    program = "import pickle; pickle.loads(pickle.dumps(print))"
    ended = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr[:9]) == (97, "UNPICKLED")


def summary(directory: Path) -> dict:
    return json.loads((directory / "summary.json").read_text())


def metrics(directory: Path) -> list[dict[str, str]]:
    with (directory / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def newest_checkpoint(directory: Path) -> Path:
    return max((directory / "checkpoints").iterdir())


def is_free(directory: Path) -> bool:
    try:
        RunLock(directory).close()
    except RunInUseError:
        return False
    return True


def test_a_run_whose_last_checkpoint_cannot_be_saved_fails(start: Start, tmp_path: Path) -> None:
    running = start("train", "cartpole", "--actors", 1, "--env-steps", 500, *SHORT, "--run-dir", "a run")
    running.expect("run directory")
    in_the_way = tmp_path / "a run" / "checkpoints"
    in_the_way.write_text("")
    assert running.wait() == 1, running.output
    running.expect(r"the last checkpoint, at [\d,]+ env_steps, could not be saved: ")
    running.expect("so the run has no result: make room on the disk, or make it writable, then type: ")
    running.expect("daedalus resume 'a run'$")
    assert "evaluat" not in running.output


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Train CartPole until it is solved. Several tests check this run."""
    folder = tmp_path_factory.mktemp("solved")
    with starting(folder) as start:
        # More than the budget of the preset: asynchronous runs differ, and these tests do not check the speed of
        # learning.
        # Of a lower target, which takes a fraction of the time.
        target = ("--set", f"training.target_return={TARGET}", "--set", f"training.target_episodes={EPISODES}")
        final = ("--set", "evaluation.final_episodes=20")
        running = start(
            "train", "cartpole", "--env-steps", 4_000_000, "--run-dir", "solved-run", *target, *final, report=True
        )
        assert running.wait() == 0, running.output
    assert "UNPICKLED" not in running.output
    return folder / "solved-run", running.output


def test_cartpole_is_solved_and_evaluated(solved: tuple[Path, str]) -> None:
    directory, output = solved
    result = summary(directory)
    assert result["solved"] is True
    assert result["episode_return_mean"] >= TARGET
    # An untrained policy has 10. Greedy actions differ from the sampled actions of training.
    assert result["evaluation_return_mean"] > 60
    assert 0 < result["seconds_to_target"] <= result["wall_seconds"]
    assert result["rollouts_rejected"] == {}
    assert result["snapshots_published"] == result["updates"] + 1
    assert f"solved: mean return {TARGET} reached" in output
    confirmation = result["confirmation"]
    assert confirmation["episodes"] == EPISODES
    assert confirmation["interval"][1] >= TARGET
    seed = confirmation["seed"]
    again = evaluate(confirmation["checkpoint"], actions="sampled", seed=seed, episodes=EPISODES)
    assert seed not in (1, 1 + 2**32, 1 + 2**33)  # training, the final evaluation, the selection
    assert (again.return_mean, again.return_std) == (confirmation["return_mean"], confirmation["return_std"])
    assert again.policy_version == confirmation["policy_version"]
    assert f"over {EPISODES} new sampled episodes of the policy at that moment, 95 % interval" in output
    assert "evaluation: return" in output


def test_summary_counts_agree_with_each_other(solved: tuple[Path, str]) -> None:
    result = summary(solved[0])
    assert result["env_steps"] <= result["rollouts_accepted"] * 128 * 32
    assert 0 <= result["policy_lag_mean"] <= result["policy_lag_max"] <= 32
    assert 1 < result["rollout_bytes_per_env_step"] < 30
    assert result["env_steps_per_second"] > 0


def test_the_run_directory_is_complete(solved: tuple[Path, str]) -> None:
    directory, _ = solved
    slow = {"output.log", "confirmation.log"}  # a slow evaluation shows its progress
    names = {entry.name.split(".out.")[0] for entry in directory.iterdir()} - slow
    assert names == {
        "learner.lock",
        "config.toml",
        "versions.json",
        "metrics.csv",
        "events",
        "events.jsonl",
        "checkpoints",
        "summary.json",
        "evaluation.json",
        "report.html",
    }
    rows = metrics(directory)
    assert int(rows[-1]["env_steps"]) == summary(directory)["env_steps"]
    learned = [float(row["entropy"]) for row in rows if row["entropy"]]  # a row of a stop may come after no update
    assert min(learned) > 0


def test_no_process_and_no_open_port_is_left(solved: tuple[Path, str]) -> None:
    assert not processes_mentioning("solved-run")
    assert is_nothing_left(solved[1])


def test_resume_has_nothing_to_do_or_continues_with_new_settings_and_its_trackers(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    small = ("--actors", 1, "--set", "evaluation.final_episodes=0", "--log", "wandb")
    first = start("train", "cartpole", "--env-steps", 4000, "--run-dir", "run", *small)
    assert first.wait() == 3, first.output  # the budget ended without the target
    first.expect("wandb: recorded offline; upload the run with: wandb sync .*/run/wandb/offline-run-")
    tracked = wandb_run(tmp_path / "run")
    first.expect("^not evaluated .evaluation.final_episodes=0.: daedalus evaluate run$")
    assert "summary/evaluation.episodes" not in tracked["summary"]
    before = newest_checkpoint(tmp_path / "run")
    rows, end = metrics(tmp_path / "run"), summary(tmp_path / "run")

    idle = start("resume", "run", "--set", "service.log_seconds=0.1")
    assert idle.wait() == 3, idle.output
    assert idle.lines == [
        f"nothing to do: {end['env_steps']:,} env_steps are done, and the budget is 4,000: raise it with --env-steps"
    ]
    assert newest_checkpoint(tmp_path / "run") == before
    assert (metrics(tmp_path / "run"), summary(tmp_path / "run")) == (rows, end)

    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    config = (tmp_path / "run" / "config.toml").read_text()
    refused = start("resume", "run", "--env-steps", 12000, "--set", "training.device=cuda")
    assert refused.wait() == 1, refused.output
    refused.expect("daedalus learner: training.device is cuda, but torch finds no CUDA device: install")
    refused.expect("config.toml has the settings from before again")
    assert "Traceback" not in refused.output
    assert (tmp_path / "run" / "config.toml").read_text() == config

    changed = ("--set", "training.learning_rate_final=0.0001", "--set", "evaluation.final_episodes=2")
    further = start("resume", "run", "--env-steps", 12000, *changed)
    assert further.wait() == 3, further.output
    assert not (tmp_path / "run" / "config.toml.before").exists()
    result = summary(tmp_path / "run")
    assert result["env_steps"] >= 12000
    assert result["evaluation"]["episodes"] == 2
    assert int(newest_checkpoint(tmp_path / "run").name) == result["updates"] > int(before.name)
    rows = metrics(tmp_path / "run")
    assert [int(row["env_steps"]) for row in rows] == sorted(int(row["env_steps"]) for row in rows)
    assert float(rows[-1]["learning_rate"]) == pytest.approx(0.0001)
    again = wandb_run(tmp_path / "run")
    assert again["id"] == tracked["id"]
    assert again["config"]["training"]["learning_rate_final"] == 0.0001
    assert max(again["history"]) == result["env_steps"] > max(tracked["history"])
    assert again["summary"]["summary/evaluation.episodes"] == 2


def test_the_run_is_locked_until_the_child_processes_of_a_killed_train_have_ended(start: Start, tmp_path: Path) -> None:
    words = ("train", "cartpole", "--run-dir", "orphan-run", "--actors", 1, "--inference", "shared")
    running = start(*words, *ENDLESS, *SLOW)
    address = running.expect(r"at (unixsock-stream/\S+);").group(1)
    running.expect(r"updates .*/s")
    assert not any(map(listening_ports, processes_mentioning("orphan-run")))  # every user could connect there
    second = start("resume", "orphan-run", *PLAYING_SLOW)
    assert second.wait() == 1
    assert second.lines == [
        f"daedalus resume: run directory orphan-run is in use by process {running.process.pid} on "
        f"{socket.gethostname()}: stop it first, or choose another directory"
    ]
    running.process.kill()
    until(lambda: not processes_mentioning(address) and not processes_mentioning("orphan-run"))
    until(lambda: is_free(tmp_path / "orphan-run"))


def test_a_killed_actor_and_a_killed_learner_are_restarted_and_training_reaches_its_end(
    start: Start, tmp_path: Path
) -> None:
    settings = (*ENDLESS[:2], *SLOW, "--set", "evaluation.final_episodes=0", "--log-json")
    saving = ("--set", "service.checkpoint_seconds=0.3")
    running = start("train", "cartpole", "--run-dir", "fallen-run", "--env-steps", 10_000, *settings, *saving)
    address = running.expect(r"at (unixsock-stream/\S+);").group(1)
    running.expect(r"updates .*/s.* actors 2")
    (victim,) = [pid for pid in processes_mentioning("actor-1") if pid in processes_mentioning(address)]
    os.kill(victim, signal.SIGKILL)
    running.expect("actor-1 was killed by signal 9; started again")
    left = ("left", "actor-1")  # events are written every few seconds
    until(lambda: left in [(event.kind, event.actor) for event in read_events(tmp_path / "fallen-run")])
    (victim,) = {*processes_mentioning("--prepared")} & {*processes_mentioning("fallen-run")}
    os.kill(victim, signal.SIGKILL)
    assert running.wait() in (0, 3), running.output
    assert running.output.count("the learner was killed by signal 9; started again") == 1
    assert running.output.count("resuming from checkpoint") == 1
    assert "Traceback" not in running.output
    assert "UNPICKLED" not in running.output  # also after a checkpoint was read
    assert summary(tmp_path / "fallen-run")["env_steps"] >= 10_000
    assert not processes_mentioning("fallen-run")
    assert not processes_mentioning(address)
    recorded = [(event.kind, event.actor) for event in read_events(tmp_path / "fallen-run")]
    assert recorded[0] == ("started", "")
    assert {("joined", "actor-0"), ("joined", "actor-1"), ("left", "actor-1"), ("restarted", "")} <= {*recorded}
    assert ("ended", "") in recorded
    expect_each_log_record_as_one_json_object(running)


def expect_each_log_record_as_one_json_object(running: Running) -> None:
    records = [json.loads(line) for line in running.lines if line.startswith("{")]
    assert all({"time", "level", "logger", "message"} <= record.keys() for record in records)
    assert {"daedalus.launch.local_training", "daedalus.learner.serving.events"} <= {
        record["logger"] for record in records
    }
    plain = [line for line in running.lines if not line.startswith("{")]
    assert not {record["message"] for record in records} & set(plain)
    *progress, outcome, evaluation, left = plain
    assert all(re.search(r"return .* env_steps .* actors \d+$", line) for line in progress), running.output
    assert (outcome.split(":")[0] in ("solved", "done"), evaluation.split(" (")[0]) == (True, "not evaluated")
    assert left.startswith("for a report with the curves: pip install ")


def test_an_environment_of_the_user_may_print(start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module is in the working directory; it prints in every step, also from a process of its own."""
    monkeypatch.delenv("PYTHONPATH")  # a process of an environment unpickles what its parent gave to it
    source = (Path(__file__).parent.parent / "counting_environment.py").read_text()
    noise = "        print('noise'); self._step or os.system('echo from a process')\n"
    noisy = source.replace("        self._step += 1\n", f"{noise}        self._step += 1\n")
    (tmp_path / "my_module.py").write_text(noisy.replace("import gymnasium\n", "import os\nimport gymnasium\n", 1))
    few = ("--set", "collection.envs_per_actor=2", "--set", "evaluation.final_episodes=1")
    running = start("train", "--env", "my_module:Counting-v0", "--env-steps", 600, *few, "--run-dir", "own")
    assert running.wait() == 0, running.output
    assert running.lines.count("noise") < 200
    running.expect(r"[\d,]+ lines of output were not shown; see own/output.log")
    log = (tmp_path / "own" / "output.log").read_text().splitlines()
    for line in ("[actor-1] noise", "[evaluation-0] noise", "[evaluation-0] from a process"):
        assert line in log
    result = summary(tmp_path / "own")
    assert result["env_steps"] >= 600
    assert result["solved"] is False
    parameters = safetensors.numpy.load_file(newest_checkpoint(tmp_path / "own") / "parameters.safetensors")
    assert all(np.isfinite(array).all() for array in parameters.values())
