"""Actors where a system lacks what only POSIX has, such as Windows."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Running

TESTS = Path(__file__).parents[1]
OWN_LOOP = TESTS.parent / "examples" / "own_loop.py"
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
