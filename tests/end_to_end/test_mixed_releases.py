"""A learner and an actor of different releases: one of the processes has a setting that the other does not know."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Running, free_address, starting

Start = Callable[..., Running]

# Loaded by every Python process that has its folder on the path: a release whose environments have one more setting.
NEWER = """
import importlib.abc, importlib.machinery, sys

class Newer(importlib.machinery.SourceFileLoader):
    def get_code(self, name):
        source = self.get_data(self.path).decode()
        before = "    backend: Backend ="
        assert source.count(before) == 1
        return compile(source.replace(before, "    newer: int = 0\\n" + before), self.path, "exec")

class Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name != "daedalus.protocol.spec":
            return None
        found = importlib.machinery.PathFinder.find_spec(name, path)
        found.loader = Newer(name, found.origin)
        return found

sys.meta_path.insert(0, Finder())
"""


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    with starting(tmp_path) as start:
        yield start


@pytest.fixture
def newer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], None]:
    """Return what decides whether processes that are started from now on are of the newer release."""
    folder = tmp_path / "newer"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(NEWER)

    def choose(is_newer: bool) -> None:
        monkeypatch.setenv("PYTHONPATH", str(folder) if is_newer else "")

    return choose


@pytest.mark.parametrize("learner_is_newer", [True, False])
def test_actor_and_learner_of_different_releases_train_together(
    start: Start, newer: Callable[[bool], None], learner_is_newer: bool
) -> None:
    address = free_address()
    newer(learner_is_newer)
    known = ("--set", "environment.newer=0") if learner_is_newer else ()
    learner = start("learner", "cartpole", "--listen", address, "--run-dir", "run", "--env-steps", 3000, *known)
    learner.expect("actors join with")
    newer(not learner_is_newer)
    actor = start("actor", "--connect", address, "--name", "other", "--envs", 4)
    actor.expect("joined run 'run'")
    assert learner.wait() == 3, learner.output  # the budget, learned from accepted rollouts
    assert actor.wait() == 0, actor.output


def test_actor_refuses_a_run_that_uses_a_setting_of_a_newer_release(
    start: Start, newer: Callable[[bool], None]
) -> None:
    address, reason = free_address(), "the run sets environment.newer, which this release does not know: upgrade"
    newer(True)
    changed = ("--set", "environment.newer=1")
    learner = start("learner", "cartpole", "--listen", address, "--run-dir", "run", *changed)
    learner.expect("actors join with")
    newer(False)
    actor = start("actor", "--connect", address, "--name", "older", "--envs", 4)
    actor.expect(reason)
    assert actor.wait() == 1
    learner.expect(f"failed .*{reason}")
