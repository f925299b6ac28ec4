"""A learner of several processes: one of them dies, all of them end, and torchrun starts them."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import DAEDALUS, LIMIT, Running, free_address, processes_mentioning, until

Start = Callable[..., Running]
ENDLESS = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)


def children(pid: int) -> list[int]:
    """Return the ids of the processes that a process has started."""
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:  # it has ended
        return []


def only_child(pid: int, command: str) -> int:
    """Wait until a process has a child that runs a command, and return its id."""
    found: list[int] = []
    until(lambda: found.extend(set(children(pid)) & set(processes_mentioning(command))) or found)
    return found[0]


def is_there(pid: int) -> bool:
    try:
        return " Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False


def test_a_killed_rank_restarts_the_learner_and_a_signal_ends_all(start: Start, address: str) -> None:
    service = ("--set", "service.checkpoint_seconds=0.2", *ENDLESS)
    learner = start("learner", "cartpole", "--processes", 2, "--listen", address, "--run-dir", "run", *service)
    actor = start("actor", "--connect", address)
    learner.expect("checkpoint saved")
    first = only_child(learner.process.pid, "commands.learner")
    other = only_child(first, "commands.rank")
    os.kill(other, signal.SIGKILL)
    learner.expect("^daedalus learner: process 1 of the learner was killed by signal 9$")
    learner.expect("the learner lost one of its processes; started again")
    learner.expect(r"resuming from checkpoint \d+ at ")
    until(lambda: learner.output.count("2 processes compute the updates") == 2)
    second = only_child(learner.process.pid, "commands.learner")
    other = only_child(second, "commands.rank")
    assert not is_there(first)
    learner.process.terminate()
    assert learner.wait() == 0, learner.output
    until(lambda: not is_there(second) and not is_there(other))
    assert actor.process.poll() is None  # it waits for the learner


def test_no_rank_outlives_rank_0(tmp_path: Path) -> None:
    program = "\n".join(
        [
            "import os, signal, threading",
            "from daedalus.cli.ranks import StartedRanks",
            "from daedalus.protocol.spec import RunSpec",
            "spec = RunSpec.model_validate({'environment': {'id': 'CartPole-v1'}})",
            "with StartedRanks(2, []) as ranks:",
            "    leader = ranks.open(spec, threading.Event())",
            "    print('ranks', *(process.pid for process in ranks._processes), flush=True)",
            "    os.kill(os.getpid(), signal.SIGKILL)",
        ]
    )
    running = Running([sys.executable, "-P", "-c", program], tmp_path)
    try:
        other = int(running.expect(r"^ranks (\d+)$")[1])
        until(lambda: not is_there(other))
    finally:
        running.end()


class Launched:
    """Two ranks on this machine, started as torchrun does."""

    def __init__(self, directory: Path, *options: tuple[object, ...]) -> None:
        port = free_address().rpartition(":")[2]
        place = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        self.processes = [
            subprocess.Popen(
                [*DAEDALUS, "learner", *map(str, own)],
                cwd=directory,
                env={**os.environ, **place, "RANK": str(rank), "LOCAL_RANK": str(rank)},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for rank, own in enumerate(options)
        ]

    def wait(self) -> list[tuple[int, str]]:
        """Return exit status and output of each rank."""
        try:
            outputs = [process.communicate(timeout=LIMIT)[0] for process in self.processes]
            return [(process.returncode, text) for process, text in zip(self.processes, outputs, strict=True)]
        finally:
            for process in self.processes:
                process.kill()


def test_torchrun_starts_the_ranks_of_a_learner(start: Start, address: str, tmp_path: Path) -> None:
    options = ("cartpole", "--listen", address, "--run-dir", "run", "--resume", "--env-steps", 30_000)
    ranks = Launched(tmp_path, options, options)
    actor = start("actor", "--connect", address)
    (first, text), (second, other) = ranks.wait()
    assert (first, second) == (3, 0), text + other
    assert actor.wait() == 0


@pytest.mark.parametrize("command", ["learner", "train"])
def test_processes_that_would_have_nothing_to_do_are_refused(start: Start, command: str) -> None:
    options = ("--algorithm", "a3c", "--set", "collection.upload=gradients")
    refused = start(command, "cartpole", "--processes", 2, *options)
    assert refused.wait() == 2
    assert re.fullmatch(
        f"daedalus {command}: collection.upload is gradients: .*; leave out --processes, or .*", refused.output
    )
