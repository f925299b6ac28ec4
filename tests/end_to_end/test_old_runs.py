"""Run directories of earlier versions are resumed and evaluated, or their error says what to do.

There is no release yet, so that those in tests/old_runs were made by the commits that they are named after: CartPole,
impala, a network of 4 units, 3,000 env_steps, as `daedalus train` of that commit left them, in archives. Replace them
by those of tags once there are some.
"""

import lzma
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from processes import Running

import daedalus
from daedalus.analysis.run_archive import read_archive
from daedalus.learner.run.resuming import Beginning
from daedalus.learner.run.run_directory import CONFIG, read_config, releases_of
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.checkpoint import load_newest
from daedalus.learner.training.learner import Learner
from daedalus.protocol.releases import own_release

OLD_RUNS = Path(__file__).parents[1] / "old_runs"
FIRST_OF_FORMAT_2 = "0781bde1"  # the first checkpoints that this release reads
MIXES = "2cac2d32"  # the oldest commit whose actors and learners work with ours
FORMAT_1 = "f5dfd017"
OTHER_NAMES = "6f0875e6"  # of format 1, before settings had their present names


def restored(name: str, folder: Path) -> Path:
    """Return the directory of a run that an earlier version made."""
    archive = folder / f"{name}.tar"
    with lzma.open(OLD_RUNS / f"{archive.name}.xz") as packed, archive.open("wb") as unpacked:
        shutil.copyfileobj(packed, unpacked)
    read_archive(archive).restore(folder / name)
    return folder / name


@pytest.mark.parametrize("name", [FIRST_OF_FORMAT_2, MIXES])
def test_a_run_of_an_earlier_version_can_be_evaluated_and_continued(tmp_path: Path, name: str) -> None:
    run = restored(name, tmp_path)
    assert releases_of(run) == ("daedalus-rl 0.1.0", "daedalus-rl 0.1.0")
    assert daedalus.load_policy(run).act(np.zeros(4, np.float32)) in (0, 1)
    assert daedalus.read_metrics(run)["env_steps"][-1] > 3000
    spec, checkpoint = read_config(run), load_newest(run)
    learner = Learner(spec.training, spec.policy, checkpoint.policy.spaces)
    Beginning(restored=checkpoint).load_into(learner, spec, 0.5)
    assert learner.policy_version == 25


def test_a_run_of_an_earlier_version_is_resumed(start: Callable[..., Running], tmp_path: Path) -> None:
    run = restored(FIRST_OF_FORMAT_2, tmp_path)
    resumed = start("resume", run, "--env-steps", 4000, "--set", "evaluation.final_episodes=0")
    assert resumed.wait() == 3, resumed.output  # the budget
    resumed.expect("done: 4,0.. env_steps")
    assert (run / CONFIG).read_text().startswith(f"# written by {own_release()}\n")
    assert load_newest(run).policy.policy_version > 25


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            FORMAT_1,
            "has format 1 of checkpoints, and this release reads format 2 only: use the release that wrote it, ",
        ),
        (
            OTHER_NAMES,
            "environment.continuing is of an earlier release: environment.bootstrap_terminations replaces it",
        ),
    ],
)
def test_a_run_that_is_too_old_says_what_to_do(
    start: Callable[..., Running], address: str, tmp_path: Path, name: str, reason: str
) -> None:
    run = restored(name, tmp_path)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    with pytest.raises(daedalus.DamagedError, match=r"train again from the run's config\.toml"):
        daedalus.load_policy(run)
    words = ("--env-steps", 4000)
    for resumed in (
        start("learner", "--run-dir", run, "--resume", "--listen", address, *words),
        start("resume", run, *words),
    ):
        assert resumed.wait() in (1, 2), resumed.output
        resumed.expect(reason)
    assert {path: path.read_bytes() for path in before} == before


def test_a_run_of_a_newer_release_names_it(tmp_path: Path) -> None:
    run = restored(MIXES, tmp_path)
    settings = (run / CONFIG).read_text()
    (run / CONFIG).write_text(f"# written by daedalus-rl 99.1\n{settings}\n[future]\nsetting = 1\n")
    newer = r"daedalus-rl 99.1 wrote it, which is newer than this one, .*: pip install 'daedalus-rl>=99.1'$"
    with pytest.raises(SettingsError, match=rf"unknown setting future.*; {newer}"):
        read_config(run)
    for strange in ("# written by 7; rm -rf", "# written by daedalus-rl \u202e9", "#"):  # no release
        (run / CONFIG).write_text(f"{strange}\n{settings}\n[future]\nsetting = 1\n")
        with pytest.raises(SettingsError, match=r"unknown setting future: [^;]*$"):
            read_config(run)
