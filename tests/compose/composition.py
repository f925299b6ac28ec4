"""The services of docker-compose.yml during the test."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from docker_host import run

HERE = Path(__file__).parent
LIMIT = 600.0  # seconds; timeout of each step, long enough for a slow machine
_ROOT = HERE.parents[1]
_PROJECT = "daedalus-test"


class Compose:
    """The docker-compose.yml of the project with the changes of override.yml and endless.yml."""

    def __init__(self, command: list[str]) -> None:
        self._command = command
        self.endless = True  # whether the learner runs the command of endless.yml

    def __call__(self, *arguments: str, check: bool = True) -> str:
        """Run `docker compose ARGUMENTS` and return its output."""
        files = [_ROOT / "docker-compose.yml", HERE / "override.yml", *([HERE / "endless.yml"] if self.endless else [])]
        words = [*self._command, "--project-directory", str(_ROOT), "--project-name", _PROJECT]
        words += [word for file in files for word in ("--file", str(file))]
        return run(*words, *arguments, check=check).stdout

    def up(self, actors: int) -> None:
        """Start, scale or restart the containers, as a user does."""
        self("up", "--detach", "--scale", f"actor={actors}")

    def containers(self, service: str) -> list[str]:
        """Return the ids of a service's containers, running or not."""
        mine = ("--filter", f"label=com.docker.compose.project={_PROJECT}")
        return run(
            *("docker", "ps", "--all", "--quiet", "--no-trunc", *mine),
            *("--filter", f"label=com.docker.compose.service={service}"),
        ).stdout.split()

    def state(self, container: str) -> dict[str, Any]:
        """Return the state of a container as docker reports it."""
        return json.loads(run("docker", "inspect", "--format", "{{json .State}}", container).stdout)

    def status(self) -> dict[str, Any] | None:
        """Return the status of the learner, or None if no learner answers."""
        words = ("exec", "-T", "router", "daedalus", "status", "--connect", "tcp/127.0.0.1:7447", "--json")
        found = [line for line in self(*words, check=False).splitlines() if line.startswith("{")]
        return json.loads(found[0]) if found else None

    def wait(self, description: str, condition: Callable[[], object]) -> None:
        """Wait until a condition holds. After the timeout, fail with the output of the containers."""
        began = time.monotonic()
        while not condition():
            if time.monotonic() > began + LIMIT:
                pytest.fail(f"{description}: not within {LIMIT:g} s\n{self('logs', '--tail', '20', check=False)}")
            time.sleep(1.0)
        print(f"  {description}: {time.monotonic() - began:.0f} s", flush=True)
