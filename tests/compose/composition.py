"""docker-compose.yml as the test runs it."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from docker_host import run

HERE = Path(__file__).parent
LIMIT = 600.0  # seconds that anything may take on a slow machine; nothing waits so long on a healthy one
_ROOT = HERE.parents[1]
_PROJECT = "daedalus-test"


class Compose:
    """The project's docker-compose.yml as the test runs it."""

    def __init__(self, command: list[str]) -> None:
        self._command = command
        self.endless = True  # what the learner runs: endless.yml, or what is shipped

    def __call__(self, *arguments: str, check: bool = True) -> str:
        """Runs `docker compose ARGUMENTS`; returns what it printed."""
        files = [_ROOT / "docker-compose.yml", HERE / "override.yml", *([HERE / "endless.yml"] if self.endless else [])]
        words = [*self._command, "--project-directory", str(_ROOT), "--project-name", _PROJECT]
        words += [word for file in files for word in ("--file", str(file))]
        return run(*words, *arguments, check=check).stdout

    def up(self, actors: int) -> None:
        """What a user types to begin, to scale, and to start again what was killed."""
        self("up", "--detach", "--scale", f"actor={actors}")

    def containers(self, service: str) -> list[str]:
        """The ids of a service's containers, running or not."""
        mine = ("--filter", f"label=com.docker.compose.project={_PROJECT}")
        return run(
            *("docker", "ps", "--all", "--quiet", "--no-trunc", *mine),
            *("--filter", f"label=com.docker.compose.service={service}"),
        ).stdout.split()

    def state(self, container: str) -> dict[str, Any]:
        """What docker tells of a container's state."""
        return json.loads(run("docker", "inspect", "--format", "{{json .State}}", container).stdout)

    def status(self) -> dict[str, Any] | None:
        """What the learner tells; None while none answers."""
        words = ("exec", "-T", "router", "daedalus", "status", "--connect", "tcp/127.0.0.1:7447", "--json")
        found = [line for line in self(*words, check=False).splitlines() if line.startswith("{")]
        return json.loads(found[0]) if found else None

    def wait(self, what: str, condition: Callable[[], object]) -> None:
        """Waits until a condition holds; if it never does, shows what the containers said."""
        began = time.monotonic()
        while not condition():
            if time.monotonic() > began + LIMIT:
                pytest.fail(f"{what}: not within {LIMIT:g} s\n{self('logs', '--tail', '20', check=False)}")
            time.sleep(1.0)
        print(f"  {what}: {time.monotonic() - began:.0f} s", flush=True)
