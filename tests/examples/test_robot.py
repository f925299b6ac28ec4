"""examples/robot.py in a short form, which does not depend on the speed of the machine."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Running

EXAMPLE = Path(__file__).parents[2] / "examples" / "robot.py"


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    running: list[Running] = []

    def start_one(*arguments: str) -> Running:
        running.append(Running([sys.executable, str(EXAMPLE), *arguments], tmp_path))
        return running[-1]

    yield start_one
    for one in running:
        one.end()


def test_an_arm_behind_a_bad_network_is_learned_from(
    start: Callable[..., Running], address: str, robot: Callable[..., Running]
) -> None:
    words = ("learner", "--env", "Arm", "--algorithm", "appo", "--actors", 1, "--env-steps", 60, "--run-dir", "run")
    sizes = ("--set", "collection.rollout_length=10", "--set", "training.batch_rollouts=2")
    learner = start(*words, *sizes, "--listen", address)
    arm = robot(address, "--seconds", "60", "--delay-p99", "0.05")
    assert learner.wait() == 0, learner.output  # the budget ended, and there is no target
    assert arm.wait() == 0, arm.output  # the clock ends with the run
    arm.expect(r"[\d,]+ of [\d,]+ deadlines missed; delays of the network: median \d+ ms, p99 \d+ ms, each way")
