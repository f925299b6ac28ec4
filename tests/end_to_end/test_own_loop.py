"""Loops that the caller owns, and learners and actors where a system lacks what only POSIX has."""

import json
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Running

_EXAMPLES = Path(__file__).parents[2] / "examples"
OWN_LOOP, AGENTS = _EXAMPLES / "own_loop.py", _EXAMPLES / "several_agents.py"


@pytest.fixture
def example(tmp_path: Path, address: str) -> Iterator[Callable[..., Running]]:
    running: list[Running] = []

    def start_one(*arguments: str, script: Path = OWN_LOOP) -> Running:
        running.append(Running([sys.executable, str(script), address, *arguments], tmp_path))
        return running[-1]

    yield start_one
    for one in running:
        one.end()


def test_the_agents_of_one_loop_are_one_actor(
    start: Callable[..., Running],
    address: str,
    example: Callable[..., Running],
    tmp_path: Path,
) -> None:
    sizes = ("--set", "collection.rollout_length=64", "--env-steps", 3_000, "--actors", 1, "--run-dir", "run")
    learner = start("learner", "cartpole", "--algorithm", "a2c", *sizes, "--listen", address)
    loop = example("--name", "robots", "--agents", "3", script=AGENTS)
    loop.expect("joined run 'run' as 'robots': 3 x CartPole-v1")
    assert learner.wait() == 3, learner.output  # the budget ended without the target
    assert loop.wait() == 0, loop.output
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["env_steps"] >= 3_000
    assert summary["episodes"] >= 3_000 // 500 - 3  # of at most 500 env_steps, and one of each agent has not ended
    assert summary["rollouts_rejected"].keys() <= {"stale"}


TESTS = Path(__file__).parents[1]
SMALL = (
    "--actors",
    1,
    "--env-steps",
    3000,
    "--set",
    "collection.rollout_length=32",
    "--set",
    "training.batch_rollouts=2",
)

Start = Callable[..., Running]


@pytest.fixture
def portable(tmp_path: Path) -> Iterator[Start]:
    """Start a Python process that, with its children, lacks what only POSIX has."""
    running: list[Running] = []

    def start(*arguments: object) -> Running:
        lacking = f"PYTHONPATH={TESTS / 'without_posix'}"
        running.append(Running(["env", lacking, sys.executable, *map(str, arguments)], tmp_path))
        return running[-1]

    yield start
    for one in running:
        one.end()


# `daedalus learner`, which has imported every module that a learner may need, also those of other settings.
LEARNER = """
import importlib, pkgutil, runpy, daedalus.algorithms, daedalus.learner, daedalus.launch, daedalus.policy
for package in (daedalus.algorithms, daedalus.learner, daedalus.launch, daedalus.policy):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)
runpy.run_module("daedalus.cli.commands.learner", run_name="__main__", alter_sys=True)
"""


def test_a_learner_with_every_module_an_actor_and_a_client_run_to_the_end(address: str, portable: Start) -> None:
    learner = portable("-c", LEARNER, "cartpole", *SMALL, "--listen", address, "--run-dir", "run")
    learner.expect("this system has no such locks: start no second learner in")
    actor = portable("-m", "daedalus", "actor", "--connect", address, "--name", "plain", "--envs", 2)
    loop = portable(OWN_LOOP, address, "--name", "robot")
    loop.expect("joined run 'run' as 'robot': 1 x CartPole-v1")
    assert learner.wait() == 3, learner.output  # the budget ended without the target
    for ended in (actor, loop):
        assert ended.wait() == 0, ended.output
        ended.expect("the run is over")


def test_a_training_that_is_stopped_saves_a_checkpoint(portable: Start) -> None:
    endless = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9, "--actors", 1)
    training = portable("-m", "daedalus", "train", "cartpole", *endless, "--run-dir", "run")
    training.expect("every user of this machine can connect to tcp/127.0.0.1:")
    training.expect(r" env_steps +[1-9]")
    training.process.send_signal(signal.SIGINT)  # to this process alone
    assert training.wait() == 1, training.output
    training.expect(r"stopped; checkpoint saved at [1-9][\d,]* env_steps: run/checkpoints/")
