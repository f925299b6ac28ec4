"""How the processes of environments start: forked from a server without the modules of the parent, or anew."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

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
