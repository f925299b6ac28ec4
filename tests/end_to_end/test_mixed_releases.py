"""A learner and an actor of different releases: one of them runs from the wheel of the oldest commit that mixes."""

import io
import shutil
import subprocess
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from installing import build, installed, run
from processes import DAEDALUS, Running, free_address, starting

ROOT = Path(__file__).parents[2]
# The first commit whose Welcome carries ActorSpec: every commit since then works with every other. Replace it by the
# first tag once there is one, and by a later commit only with a new protocol version.
OLDEST = "2cac2d323af87bd83f4800fbe9593a2b351c893c"

Start = Callable[..., Running]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    with starting(tmp_path) as start:
        yield start


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the command `daedalus` of an environment in which the wheel of the oldest commit is installed."""
    if not shutil.which("git"):
        pytest.skip("git, which has the older commit, is not installed")
    archive = subprocess.run(["git", "archive", OLDEST], cwd=ROOT, capture_output=True, check=False)
    if archive.returncode:
        pytest.skip(f"{ROOT} has no history with commit {OLDEST[:7]}: fetch it with `git fetch --unshallow`")
    folder = tmp_path_factory.mktemp("older")
    with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
        files.extractall(folder / "tree", filter="data")
    packages = installed(folder / "environment", build("wheel", folder / "tree", folder / "wheel"))
    python = str(folder / "environment" / "bin" / "python")
    where = run(python, "-P", "-c", "import daedalus; print(daedalus.__file__)", folder=folder).strip()
    assert where == str(packages / "daedalus" / "__init__.py")  # not this repository
    return [python, *DAEDALUS[1:]]


@pytest.mark.parametrize("older_role", ["actor", "learner"])
def test_actor_and_learner_of_different_releases_train_together(
    start: Start, older: list[str], older_role: str
) -> None:
    address = free_address()
    commands = {role: older if role == older_role else DAEDALUS for role in ("actor", "learner")}
    run_of_the_test = ("cartpole", "--listen", address, "--run-dir", "run", "--env-steps", 3000)
    learner = start("learner", *run_of_the_test, command=commands["learner"])
    learner.expect("actors join with")
    actor = start("actor", "--connect", address, "--name", "other", "--envs", 4, command=commands["actor"])
    actor.expect("joined run 'run'")
    assert learner.wait() == 3, learner.output  # the budget, learned from accepted rollouts
    assert actor.wait() == 0, actor.output
