"""The fixture of the containers' test: `make test-compose`."""

import os
from collections.abc import Iterator

import pytest
from composition import Compose
from docker_host import BASE, UnavailableError, compose_command, daemon, make_base, run


@pytest.fixture(scope="session")
def compose() -> Iterator[Compose]:
    """Images built, nothing started; all of it is gone afterwards, but for what makes the next time shorter."""
    os.environ["DAEDALUS_PORT"] = "0"  # any free one: somebody may use the usual one
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
