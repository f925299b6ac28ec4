"""How the processes of environments start: forked from a server without the modules of the parent, or anew."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ENVIRONMENT = """
import os
import sys
from counting_environment import Counting

class Telling(Counting):
    def reset(self, **arguments):
        print(os.getppid(), *{"zenoh", "onnxruntime"} & set(sys.modules), flush=True)
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


def parents(folder: Path, **variables: str) -> list[str]:
    """Return what was printed: the id of the process, and for each environment the parent and the modules."""
    (folder / "telling.py").write_text(ENVIRONMENT)
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path]), **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    assert not result.stderr
    return result.stdout.splitlines()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems start new interpreters")
def test_processes_are_forked_from_a_server_with_nothing_of_the_parent(tmp_path: Path) -> None:
    parent, first, second = parents(tmp_path)
    assert first == second  # and no modules
    assert first.isdecimal()
    assert first != parent


def test_processes_are_new_interpreters_where_the_server_cannot_have_its_socket(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 120)
    folder.mkdir()
    parent, first, second = parents(tmp_path, TMPDIR=str(folder))
    assert [first, second] == [parent, parent]
