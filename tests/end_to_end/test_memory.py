"""Test of policies with memory: a task that needs memory, and pixels with memory."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cue_environment
from processes import Running, is_nothing_left, processes_mentioning, until

from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_score

Start = Callable[..., Running]
SETTINGS = (
    "policy.memory=gru",
    "policy.memory_units=32",
    "policy.hidden=[32]",
    "training.target_return=0.95",
    "training.learning_rate=0.003",
    "training.trace_lambda=0.95",
    "collection.envs_per_actor=32",
    "evaluation.final_episodes=20",
    "collection.rollout_length=12",  # two episodes: the memory is reset within a rollout
)


def test_a_policy_with_memory_solves_the_cue_task(start: Start, tmp_path: Path) -> None:
    """Without memory the return is 0 in the mean, after however many env_steps."""
    shutil.copy(cue_environment.__file__, tmp_path)
    options = [word for setting in SETTINGS for word in ("--set", setting)]
    run = ("--env", "cue_environment:Cue-v0", "--algorithm", "impala", "--env-steps", 200_000, "--run-dir", "run")
    running = start("train", *run, *options)
    assert running.wait() == 0, running.output
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["evaluation_return_mean"] > 0.9


def test_a_run_on_pixels_is_evaluated_and_keeps_its_best_checkpoint_and_a_signal_ends_all_its_processes(
    start: Start, tmp_path: Path
) -> None:
    """Use stacked frames, convolutions with a memory, appo, an evaluator process and one for inference."""
    (tmp_path / "pong.toml").write_text(
        """
        environment.id = "ALE/Pong-v5"
        environment.backend = "ale"
        environment.action_repeat = 4
        environment.grey = true
        environment.resize = [84, 84]
        environment.frame_stack = 4
        environment.max_episode_steps = 100
        policy = {encoder = "nature", memory = "gru", memory_units = 32}
        collection = {actors = 1, envs_per_actor = 2, rollout_length = 16}
        training = {algorithm = "appo", env_steps = 1000000, passes = 2, minibatches = 2}
        evaluation = {seconds = 0.2, episodes = 1, final_episodes = 2}
        service = {log_seconds = 0.2}
        """
    )
    running = start("train", "pong.toml", "--run-dir", "pixels-run", "--inference", "shared")
    running.expect(r"evaluation at [\d,]+ env_steps: \S+ \+- 0 over 1 episodes, the best so far")
    until(lambda: running.output.count("evaluation at") >= 2)
    running.process.terminate()
    assert running.wait() == 1
    running.expect("continue with: daedalus resume pixels-run")
    assert not processes_mentioning("pixels-run")
    assert is_nothing_left(running.output)
    with (tmp_path / "pixels-run" / "metrics.csv").open(newline="") as file:
        evaluated = [row for row in csv.DictReader(file) if row["evaluation_return_mean"]]
    assert evaluated
    assert all(int(row["evaluation_env_steps"]) <= int(row["env_steps"]) for row in evaluated)
    best, *others = best_checkpoints(tmp_path / "pixels-run")
    assert len(others) <= 2
    assert float(f"{best_score(best):.6g}") >= max(float(row["evaluation_return_mean"]) for row in evaluated)
    played = start("evaluate", "pixels-run", "--episodes", 1, "--json")
    assert played.wait() == 0, played.output
    assert json.loads(played.lines[-1])["best_checkpoint"]
