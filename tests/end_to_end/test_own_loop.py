"""examples/own_loop.py against a real learner."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Running

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_loop.py"


@pytest.fixture
def example(tmp_path: Path, address: str) -> Iterator[Callable[..., Running]]:
    running: list[Running] = []

    def start_one(*arguments: str) -> Running:
        running.append(Running([sys.executable, str(EXAMPLE), address, *arguments], tmp_path))
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


def test_a_client_takes_part_in_a_synchronous_run(
    start: Callable[..., Running], address: str, example: Callable[..., Running]
) -> None:
    words = ("learner", "cartpole", "--algorithm", "a2c", "--env-steps", 1000, "--actors", 1, "--run-dir", "run")
    learner = start(*words, "--listen", address, "--set", "collection.rollout_length=32")
    loop = example("--name", "robot")
    assert learner.wait() == 3, learner.output  # the budget ended without the target
    assert loop.wait() == 0, loop.output
    loop.expect("the run is over")
