"""Build the distribution from a source tree, and install it into an environment without this repository."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

_BUILD = "import sys, setuptools.build_meta as backend; getattr(backend, sys.argv[1])(sys.argv[2])"


def run(*words: str | Path, folder: Path) -> str:
    """Run a command without this repository on the path and return its output."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run(
        words, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    assert result.returncode == 0, result.stdout
    return result.stdout


def build(kind: str, tree: Path, target: Path) -> Path:
    """Build the `sdist` or the `wheel` of a source tree, without network; return it in a new folder `target`."""
    target.mkdir()
    run(sys.executable, "-c", _BUILD, f"build_{kind}", target, folder=tree)
    (built,) = target.iterdir()
    return built


def installed(environment: Path, *packages_to_install: str | Path) -> Path:
    """Create an environment with the packages of this one but without this repository; return its site-packages."""
    run(sys.executable, "-m", "venv", "--without-pip", environment, folder=environment.parent)
    (packages,) = environment.glob("lib/python*/site-packages")
    # Lines of a .pth file are added to the path; .pth files in the folders that they name are not read.
    (packages / "beside.pth").write_text(sysconfig.get_path("purelib") + "\n")
    # Unlike pip, uv compiles no modules, of which a test imports a part.
    uv = [Path(sysconfig.get_path("scripts")) / "uv", "pip", "install", "--python", environment / "bin" / "python"]
    options = ["--quiet", "--no-config", "--no-cache", "--no-deps", "--offline", "--no-index", "--no-build-isolation"]
    run(*uv, *options, *packages_to_install, folder=environment.parent)
    return packages
