"""Loops that the caller owns, and actors where a system lacks what only POSIX has."""

import json
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


def test_a_learner_trains_from_a_loop_that_the_caller_owns(
    start: Callable[..., Running], address: str, example: Callable[..., Running]
) -> None:
    slow = ("--set", "collection.rollout_length=64", "--set", "training.batch_rollouts=4")
    words = ("learner", "cartpole", "--env-steps", 4000, "--actors", 1, "--listen", address, "--run-dir", "run")
    learner = start(*words, *slow)
    loop = example("--name", "robot")
    loop.expect("joined run 'run' as 'robot': 1 x CartPole-v1")
    assert learner.wait() == 3, learner.output  # the budget ended without the target
    assert loop.wait() == 0, loop.output
    loop.expect("the run is over")


@pytest.mark.parametrize(("algorithm", "environments"), [("appo", 1), ("a2c", 3)])
def test_the_agents_of_one_loop_are_one_actor(
    start: Callable[..., Running],
    address: str,
    example: Callable[..., Running],
    tmp_path: Path,
    algorithm: str,
    environments: int,
) -> None:
    sizes = ("--set", "collection.rollout_length=64", "--env-steps", 3_000, "--actors", 1, "--run-dir", "run")
    learner = start("learner", "cartpole", "--algorithm", algorithm, *sizes, "--listen", address)
    loop = example("--name", "robots", "--agents", "3", script=AGENTS)
    loop.expect(f"joined run 'run' as 'robots': {environments} x CartPole-v1")
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
    """Start a script or a function without what only POSIX has."""
    running: list[Running] = []

    def start(what: str, *arguments: object) -> Running:
        line = [sys.executable, str(TESTS / "without_posix.py"), what, *map(str, arguments)]
        running.append(Running(line, tmp_path))
        return running[-1]

    yield start
    for one in running:
        one.end()


def test_an_actor_and_a_client_run_to_the_end(start: Start, address: str, portable: Start) -> None:
    learner = start("learner", "cartpole", *SMALL, "--listen", address, "--run-dir", "run")
    actor = portable("daedalus.cli.commands.actor:main", "--connect", address, "--name", "plain", "--envs", 2)
    loop = portable(str(OWN_LOOP), address, "--name", "robot")
    assert learner.wait() == 3, learner.output  # the budget ended without the target
    for ended in (actor, loop):
        assert ended.wait() == 0, ended.output
        ended.expect("the run is over")


def test_the_command_starts_the_actor_as_a_child(portable: Start) -> None:
    command = portable("daedalus.cli.main:main", "actor")
    assert command.wait() == 2, command.output
    command.expect("the following arguments are required: --connect")
