"""Docker for the test: a daemon, and a base image if none can be pulled."""

import contextlib
import json
import os
import re
import shutil
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from pip_configuration import for_image, options_of

BASE = "daedalus-test-base"  # the name in override.yml
(_PYTHON,) = re.findall(r"^ARG BASE=(\S+)$", (Path(__file__).parents[2] / "Dockerfile").read_text(), re.MULTILINE)
_STAND_IN = "daedalus-test-debian"
_STAND_IN_PACKAGES = "python3,python3-venv,python3-pip,ca-certificates"
_LIMIT = 120.0  # seconds for a daemon to start


class UnavailableError(Exception):
    """Error if the test cannot run on this machine. The message names what is missing."""


def run(*command: str | Path, check: bool = True, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command and return the result with its output. Raises AssertionError with the output."""
    result = subprocess.run(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    if check and result.returncode:
        raise AssertionError(f"{' '.join(map(str, command))}: status {result.returncode}\n{result.stdout[-4000:]}")
    return result


def compose_command() -> list[str]:
    """Return the command `docker compose` or `docker-compose`. Raises UnavailableError."""
    if shutil.which("docker") is None:
        raise UnavailableError("docker is not installed")
    for command in (["docker", "compose"], ["docker-compose"]):
        if shutil.which(command[0]) and run(*command, "version", check=False).returncode == 0:
            return command
    raise UnavailableError("docker compose is not installed")


def _answers() -> bool:
    return run("docker", "info", check=False).returncode == 0


@contextlib.contextmanager
def daemon() -> Iterator[None]:
    """Use the docker daemon of the machine, or start one for the test. Raises UnavailableError."""
    if _answers():
        yield
        return
    if shutil.which("dockerd") is None or os.geteuid() != 0:
        raise UnavailableError("no docker daemon answers, and this test cannot start one without dockerd and root")
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(["dockerd"], stdout=log, stderr=subprocess.STDOUT)
        try:
            deadline = time.monotonic() + _LIMIT
            while not _answers():
                if process.poll() is not None or time.monotonic() > deadline:
                    log.seek(0)
                    raise UnavailableError(f"dockerd does not start: {log.read()[-2000:]}")
                time.sleep(0.5)
            yield
        finally:
            process.terminate()
            process.wait()


def make_base() -> None:
    """Build the base image BASE with this machine's pip configuration and certificates.

    The configuration belongs to the machine, so it is not in the Dockerfile, and the image is removed after the test.
    """
    origin = _PYTHON if run("docker", "pull", _PYTHON, check=False).returncode == 0 else _stand_in()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        steps = [f"FROM {origin}", "COPY pip.conf /etc/pip.conf"]
        options, copied = for_image(options_of(run(sys.executable, "-m", "pip", "config", "list").stdout))
        lines = [f"{name} = {value}" for name, value in options.items()]
        (folder / "pip.conf").write_text("\n".join(["[global]", *lines, ""]))
        for index, path in enumerate(copied):
            copy = shutil.copytree if path.is_dir() else shutil.copy
            copy(path, folder / f"pip-{index}")
            steps.append(f"COPY {json.dumps([f'pip-{index}', str(path)])}")
        authorities = os.environ.get("SSL_CERT_FILE") or ssl.get_default_verify_paths().cafile
        if authorities:
            shutil.copy(authorities, folder / "authorities.crt")
            steps.append("COPY authorities.crt /etc/ssl/certs/ca-certificates.crt")
        (folder / "Dockerfile").write_text("\n".join([*steps, ""]))
        run("docker", "build", "--tag", BASE, folder)


def _stand_in() -> str:
    """Return the name of an image of Debian 12 with Python 3.11, made by debootstrap. Raises UnavailableError."""
    if run("docker", "image", "inspect", _STAND_IN, check=False).returncode == 0:
        return _STAND_IN
    if shutil.which("debootstrap") is None or os.geteuid() != 0:
        raise UnavailableError(f"{_PYTHON} cannot be pulled, and a substitute needs debootstrap and root")
    with tempfile.TemporaryDirectory() as folder:
        run("debootstrap", "--variant=minbase", f"--include={_STAND_IN_PACKAGES}", "bookworm", folder)
        for unneeded in ("var/cache/apt", "var/lib/apt/lists"):
            shutil.rmtree(Path(folder) / unneeded)
        with subprocess.Popen(["tar", "--create", "--directory", folder, "."], stdout=subprocess.PIPE) as archive:
            subprocess.run(["docker", "import", "-", _STAND_IN], stdin=archive.stdout, capture_output=True, check=True)
        assert archive.returncode == 0
    return _STAND_IN
