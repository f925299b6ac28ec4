"""Fixture of the container test, `make test-compose`."""

import os
from collections.abc import Iterator

import pytest
from composition import Compose
from docker_host import BASE, UnavailableError, compose_command, daemon, make_base, run


@pytest.fixture(scope="session")
def compose() -> Iterator[Compose]:
    """Build the images without starting containers. Afterwards remove everything except the build cache."""
    os.environ["DAEDALUS_PORT"] = "0"  # any free port: the default port may be in use
    try:
        compose = Compose(compose_command())
        with daemon():
            make_base()
            try:
                compose("build")
                yield compose
            finally:
                compose("down", "--volumes", "--timeout", "10", check=False)
                run("docker", "image", "rm", "daedalus-learner", "daedalus-actor", BASE, check=False)
                run("docker", "image", "prune", "--force", "--filter", "label=daedalus=build", check=False)
    except UnavailableError as error:
        pytest.skip(f"THE CONTAINERS WERE NOT TESTED: {error}")
