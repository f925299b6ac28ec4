"""examples/robot.py in a short form, which does not depend on the speed of the machine."""

import shutil
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
        running.append(Running([sys.executable, EXAMPLE.name, *arguments], tmp_path))
        return running[-1]

    yield start_one
    for one in running:
        one.end()


def test_an_arm_behind_a_bad_network_is_learned_from(
    start: Callable[..., Running], address: str, robot: Callable[..., Running], tmp_path: Path
) -> None:
    shutil.copy(EXAMPLE, tmp_path)
    shown = start("record", "--env", "robot:Camera", "--by", "robot:Person", "--episodes", 2, "--out", "./shown")
    assert shown.wait() == 0, shown.output
    shown.expect(r"in 2 episodes; return 100 \+- 0")
    router = start("router", "--listen", address)
    router.expect("listening on")
    words = ("learner", "--env", "robot:Camera", "--algorithm", "sac", "--actors", 1, "--demonstrations", "./shown")
    sizes = ("--set", "policy.hidden=[8]", "--set", "training.minibatch_rows=8", "--set", "training.replay_begin=10")
    learner = start(*words, *sizes, "--env-steps", 100, "--run-dir", "run", "--connect", address)
    arm = robot(address, "--camera", "--seconds", "120", "--delay-p99", "0.05")
    assert learner.wait() == 0, learner.output  # the budget ended, and there is no target
    learner.expect("demonstrations: [0-9]+ steps of ")
    assert arm.wait() == 0, arm.output  # the clock ends with the run
    arm.expect(r"[\d,]+ of [\d,]+ deadlines missed; delays of the network: median \d+ ms, p99 \d+ ms, each way")
