"""Checks that an actor installs without a compiler: a wheel of each dependency for every system that actors run on.

    python -m benchmarks.wheels

Asks the index that pip is configured with; nothing is installed. pip resolves the dependencies for each system, and
those of the dependencies too. Exit status: 0 all have wheels, 1 some have none.
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
PYTHONS = ("3.11", "3.14")
SYSTEMS = {
    "Windows": ("win_amd64",),
    "macOS, Apple silicon": ("macosx_14_0_arm64",),
    "Linux, aarch64": ("manylinux_2_28_aarch64", "manylinux_2_27_aarch64", "manylinux2014_aarch64"),
    "Linux, x86-64": ("manylinux_2_28_x86_64", "manylinux_2_27_x86_64", "manylinux2014_x86_64"),
}


def resolve(dependencies: list[str], platforms: tuple[str, ...], python: str) -> tuple[list[str], str]:
    """Return the wheels that pip would install, as `name version`, or what it says is missing."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed"]
        command += ["--only-binary=:all:", "--implementation", "cp", "--python-version", python, "--target", folder]
        command += [argument for platform in platforms for argument in ("--platform", platform)]
        report = Path(folder) / "report.json"
        found = subprocess.run(
            [*command, "--report", str(report), *dependencies], capture_output=True, text=True, check=False
        )
        if found.returncode:
            return [], found.stderr.strip().splitlines()[-1]
        chosen = json.loads(report.read_text("utf-8"))["install"]
    return sorted(f"{each['metadata']['name']} {each['metadata']['version']}" for each in chosen), ""


def main() -> int:
    """Print the result for each system, and return the exit status."""
    dependencies = tomllib.loads(PYPROJECT.read_text("utf-8"))["project"]["dependencies"]
    missing = 0
    for system, platforms in SYSTEMS.items():
        for python in PYTHONS:
            wheels, error = resolve(dependencies, platforms, python)
            missing += bool(error)
            print(f"{system}, Python {python}: {error or f'{len(wheels)} wheels: ' + ', '.join(wheels)}", flush=True)
    return int(missing > 0)


if __name__ == "__main__":
    raise SystemExit(main())
