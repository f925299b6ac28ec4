"""Processes of different releases: some run from the wheels of older commits, some as a later release would."""

import io
import re
import shutil
import subprocess
import tarfile
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from installing import build, installed, run
from learner_status import env_steps, learner_status
from processes import DAEDALUS, ENDLESS, PLAYING_SLOW, SLOW, Running, free_address, here, until

from daedalus.learner.run.setting_errors import known_names
from daedalus.protocol.releases import REPLACED_SETTINGS, own_release

ROOT = Path(__file__).parents[2]
# The first commit whose orders of operators are those of today: each since then works with each other. Replace it by
# the first tag once there is one, and by a later commit only with a new protocol version.
OLDEST = "4dc7dbc5"
# A later release whose Join and Welcome earlier ones cannot read.
LATER = """
import importlib.metadata, runpy, sys
version = importlib.metadata.version
importlib.metadata.version = lambda name: "9.9" if name == "daedalus-rl" else version(name)
from daedalus.protocol import codec, messages
codec.PROTOCOL_VERSION += 1
messages.Welcome.lowest_version = messages.Join.lowest_version = codec.PROTOCOL_VERSION
runpy.run_module(f"daedalus.cli.commands.{sys.argv.pop(1)}", run_name="__main__")  # main would replace the process
"""

Start = Callable[..., Running]


def of_oldest(*words: str) -> bytes:
    """Return the output of a command of git about the oldest commit."""
    if not shutil.which("git"):
        pytest.skip("git, which has the older commit, is not installed")
    found = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, check=False)
    if found.returncode:
        pytest.skip(f"{ROOT} has no history with commit {OLDEST}: fetch it with `git fetch --unshallow`")
    return found.stdout


def older_daedalus(folder: Path) -> list[str]:
    """Return the command `daedalus` of an environment with the wheel of the oldest commit, as release 0.0.1."""
    with tarfile.open(fileobj=io.BytesIO(of_oldest("archive", OLDEST))) as files:
        files.extractall(folder / "tree", filter="data")
    project = folder / "tree" / "pyproject.toml"
    project.write_text(re.sub(r'^version = ".*"', 'version = "0.0.1"', project.read_text(), flags=re.MULTILINE))
    packages = installed(folder / "environment", build("wheel", folder / "tree", folder / "wheel"))
    python = str(folder / "environment" / "bin" / "python")
    where = run(python, "-P", "-c", "import daedalus; print(daedalus.__file__)", folder=folder).strip()
    assert where == str(packages / "daedalus" / "__init__.py")  # not this repository
    return [python, *DAEDALUS[1:]]


def test_a_fleet_is_upgraded_host_by_host_without_a_pause_for_its_actors(start: Start, tmp_path: Path) -> None:
    """Actors may be newer than the learner, and older. A checkpoint and commands of the older release are used."""
    older, address, own = older_daedalus(tmp_path / "older"), free_address(), own_release()
    start("router", "--listen", address).expect("listening")
    exporter = start("exporter", "--connect", address, "--listen", "127.0.0.1:0")
    learner = start("learner", "cartpole", "--connect", address, "--run-dir", "run", *ENDLESS, *SLOW, command=older)
    stays = start("actor", "--connect", address, "--name", "old", "--stay", *PLAYING_SLOW, command=older)
    newer = start("actor", "--connect", address, "--name", "new", "--stay", *PLAYING_SLOW)
    learner.expect("actor=old: joined")
    learner.expect("actor=new: joined")
    status = start("status", "--connect", address)
    status.expect(f"releases: unknown: the learner; daedalus-rl 0.0.1: 1 actor; {own}: 1 actor")
    assert here("drain", "new", "--connect", address).status == 0
    assert newer.wait() == 0, newer.output
    until(lambda: env_steps(learner_status(address), "old") > 0)  # that the learner has trained on
    assert here("stop", "run", "--connect", address).status == 0
    assert learner.wait() == 0, learner.output
    upgraded = start("learner", "--connect", address, "--run-dir", "run", "--resume")
    upgraded.expect("resuming from checkpoint [1-9]")
    upgraded.expect(r"actor=old: joined .*, daedalus-rl 0\.0\.1\)")
    where = exporter.expect(r"http://\S+")[0]

    def processes() -> set[tuple[str, str]]:
        lines = urllib.request.urlopen(where).read().decode()
        return set(re.findall(r'release_processes\{role="(\w+)",run="run",software="(.*)"\} 1', lines))

    until(lambda: processes() == {("learner", own), ("actor", "daedalus-rl 0.0.1")})
    status = start("status", "--connect", address, command=older)
    status.expect("1 alive, .*; rollouts: .* accepted, 0 rejected")
    assert start("drain", "old", "--connect", address, command=older).wait() == 0
    assert stays.wait() == 0, stays.output
    upgraded.expect(r"updates .*/s")


def test_a_setting_that_went_is_named_with_what_replaced_it() -> None:
    reference = of_oldest("show", f"{OLDEST}:docs/reference/settings.md").decode()
    before = re.findall(r"^\| `(\w+)\.(\w+)` \|", reference, re.MULTILINE)
    assert len(before) > 80
    went = [f"{section}.{name}" for section, name in before if name not in known_names([section])]
    assert set(went) <= REPLACED_SETTINGS.keys()  # add what is missing, with what replaces it


def test_too_old_processes_name_the_release_that_they_need(start: Start, address: str) -> None:
    later, own = [*DAEDALUS[:-1], LATER], own_release()
    start("router", "--listen", address).expect("listening")
    learner = start("learner", "cartpole", "--connect", address, "--run-dir", "later", command=later)
    ours = start("learner", "cartpole", "--connect", address, "--run-dir", "ours")
    reason = f"{own} cannot read messages of daedalus-rl 9.9: upgrade the end that has {own} to daedalus-rl 9.9"
    learner.expect("serving run")
    ours.expect("serving run")
    too_old = start("actor", "--connect", address, "--run", "later", "--name", "too-old")
    waits = start("actor", "--connect", address, "--stay", "--run", "later", "--name", "too-old-2")
    refused = start("actor", "--connect", address, "--run", "ours", "--name", "newer", command=later)
    assert too_old.wait() == 1
    too_old.expect(f"^daedalus actor: {reason}$")
    waits.expect(f"{reason}; trying again")
    assert refused.wait() == 1
    refused.expect(f"^daedalus actor: the learner refused this actor: {reason}$")
    status = here("status", "--connect", address)
    status.expect("run later: .*, daedalus-rl 9.9$")
    status.expect("refused: newer .*daedalus-rl 9.9")  # by ours
    status.expect(rf"refused: too-old\S* .*{own}")  # as it reports to the later one
