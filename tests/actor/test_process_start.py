"""How the processes of environments start: forked from a server without the modules of the parent, or anew."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from allowed_modules import TEST_MODULES
from saved_runs import COUNTING, save

from daedalus.actor.environments.make import make_environments
from daedalus.protocol.spec import EnvironmentSpec

ENVIRONMENT = """
import json
import os
import random
import sys
import numpy
from counting_environment import Counting

class Telling(Counting):
    def reset(self, **arguments):
        modules = sorted({"zenoh", "onnxruntime"} & set(sys.modules))
        line = json.dumps([os.getppid(), modules, random.random(), numpy.random.random()])
        os.write(1, f"{line}\\n".encode())  # in one piece
        return super().reset(**arguments)
"""
PROGRAM = """
import os
import onnxruntime
import zenoh
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from telling import Telling

print(os.getpid(), flush=True)
environments = EnvironmentProcesses("Telling-v0", [Telling, Telling])
environments.reset(seed=1)
environments.close()
"""


def started(folder: Path, **variables: str) -> tuple[int, list[list[Any]]]:
    """Return the id of a process, and what each of its environments has printed.

    That is the id of the environment's parent, some imported modules, and a number of each global generator.
    """
    (folder / "telling.py").write_text(ENVIRONMENT)
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path]), **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    assert not result.stderr
    parent, *environments = map(json.loads, result.stdout.splitlines())
    return parent, environments


SCRIPT = """
import sys
import daedalus
import gymnasium
from counting_environment import Counting

print("begun", flush=True)
HALF = 0.5

class Mine(Counting):
    def step(self, action):
        assert sys.modules["__main__"].__dict__.get("HALF") is None, "the main module was imported"
        frame, reward, *ended = super().step(action)
        return frame, HALF * float(reward), *ended

gymnasium.register("CartPole-v1", Mine)
result = daedalus.evaluate("run", episodes=4, seed=1)
print(result.returns.tolist(), flush=True)
"""


@pytest.mark.parametrize("how", ["script.py", "-", "-c", "-m"])
def test_main_module_of_the_program_runs_once(tmp_path: Path, how: str) -> None:
    """Its environments are registered in their processes all the same."""
    spec = EnvironmentSpec(id="CartPole-v1", processes=True, frame_stack=4)
    made = make_environments(COUNTING, 1, modules=TEST_MODULES)
    save(tmp_path / "run", spec, 1, spaces=made.spaces, collection={"envs_per_actor": 2})
    (tmp_path / "script.py").write_text(SCRIPT)
    words = {"-c": ["-c", SCRIPT], "-m": ["-m", "script"]}.get(how, [how])
    ended = subprocess.run(
        [sys.executable, *words],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONWARNINGS": "ignore"},
        input=SCRIPT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.stderr == ""
    begun, returns = ended.stdout.splitlines()
    assert begun == "begun"
    assert len(json.loads(returns)) == 4


UNABLE = """
import sys, threading
import gymnasium
from counting_environment import Counting
from daedalus.actor.environments.make import make_environments
from daedalus.protocol.spec import EnvironmentSpec

class Box(gymnasium.spaces.Box):
    pass

class OwnSpace(Counting):
    def __init__(self):
        super().__init__()
        self.observation_space = Box(0, 9, (2,))

LOCK = threading.Lock()

class Locked(Counting):
    def step(self, action):
        with LOCK:
            return super().step(action)

for name, environment in {"OwnSpace-v0": OwnSpace, "Locked-v0": Locked}.items():
    gymnasium.register(name, environment)
    try:
        make_environments(EnvironmentSpec(id=name, processes=True), 2)
    except Exception as error:
        print(error)
"""


def test_environment_of_the_program_that_needs_its_main_module_is_refused_in_one_line(tmp_path: Path) -> None:
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONWARNINGS": "ignore"}
    (tmp_path / "unable.py").write_text(UNABLE)
    ended = subprocess.run(
        [sys.executable, "unable.py"], cwd=tmp_path, env=variables, capture_output=True, text=True, check=True
    )
    assert ended.stderr == ""
    space, lock = ended.stdout.splitlines()
    assert space.startswith("environment OwnSpace-v0 is of this program itself, and does not work in processes (")
    assert lock.startswith("environment Locked-v0 is of this program itself")
    assert lock.endswith("name it MODULE:Locked-v0, or use environment.processes=false")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems start new interpreters")
def test_processes_are_forked_from_a_server_with_nothing_of_the_parent(tmp_path: Path) -> None:
    parent, environments = started(tmp_path)
    parents, modules, *drawn = zip(*environments, strict=True)
    assert parents[0] == parents[1] != parent
    assert modules == ([], [])
    assert all(one != other for one, other in drawn)


def test_processes_are_new_interpreters_where_the_server_cannot_have_its_socket(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 120)
    folder.mkdir()
    parent, environments = started(tmp_path, TMPDIR=str(folder))
    assert [own_parent for own_parent, *_ in environments] == [parent, parent]


INTERRUPTED = """
import multiprocessing
import signal
from daedalus.actor.environments.environment_processes import _interrupts_blocked

if __name__ == "__main__":
    with _interrupts_blocked():
        process = multiprocessing.get_context("spawn").Process(target=print)
        process.start()
        print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))
    process.join()
    print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such mask")
def test_interrupts_stay_blocked_while_the_first_process_starts() -> None:
    result = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["True", "False"]
