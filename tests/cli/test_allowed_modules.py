"""Test of --allow-module: each command imports only modules that its own command line names or allows."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daedalus.cli.commands import actor, train
from daedalus.cli.commands.learner import learner_options, parser
from daedalus.cli.settings_arguments import run_choice
from daedalus.launch import local_run
from daedalus.launch.learner_process import choose_run
from daedalus.launch.local_run import LocalRun
from daedalus.learner.run import run_directory
from daedalus.policy.user_modules import ModuleNotAllowedError, allow_settings
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, RunSpec

SPEC = RunSpec(
    environment=EnvironmentSpec(id="corridor:Corridor-v0", wrap="wrappers:step_costs"),
    policy=PolicySpec(encoder="nets:Net"),
)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Path]:
    """A run directory with the user's own environment, wrapper and encoder."""
    before = sys.modules.keys() & {"corridor", "wrappers", "nets"}
    run_directory.create(tmp_path / "run", SPEC)
    yield tmp_path / "run"
    assert sys.modules.keys() & {"corridor", "wrappers", "nets"} == before


def test_resume_prints_the_command_that_allows_the_modules_of_the_run(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train.resume([str(run), "--env-steps", "9", "--allow-module", "wrappers"]) == 2
    assert capsys.readouterr().err == (
        f"daedalus resume: {run}/config.toml asks for environment.id=corridor:Corridor-v0 and policy.encoder=nets:Net, "
        "but the modules corridor and nets may not be imported here; if you trust that code, type: daedalus resume "
        f"{run} --env-steps 9 --allow-module wrappers --allow-module corridor --allow-module nets\n"
    )
    assert run_directory.read_config(run) == SPEC  # without the new budget


def test_resume_in_another_folder_than_that_of_the_module_changes_nothing(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "checkpoints" / "0000000001").mkdir(parents=True)  # without one, the environment is checked anyway
    modules = allow_settings(SPEC.user_modules)
    assert train.resume([str(run), "--env-steps", "9", *modules]) == 1
    error = capsys.readouterr().err
    assert error.startswith("daedalus resume: ")
    assert "cannot import corridor" in error
    assert "start in the folder of corridor.py" in error
    assert run_directory.read_config(run) == SPEC  # without the new budget


def test_a_learner_takes_the_word_of_its_command_line_but_not_of_the_run_directory(run: Path) -> None:
    def chosen(*words: str) -> frozenset[str]:
        return choose_run(learner_options(parser().parse_args(words), 0.0, Path())).modules.allowed

    resumed = ("--run-dir", str(run), "--resume")
    settings = ("--wrap", "wrappers:step_costs", "--set", "policy.encoder=nets:Net")
    with pytest.raises(ModuleNotAllowedError, match=re.escape(f"{run}/config.toml asks for policy.encoder=nets:Net")):
        chosen(*resumed, "--allow-module", "corridor")
    with pytest.raises(ModuleNotAllowedError):
        chosen("--prepared", str(run))
    assert chosen(*resumed, "--allow-module", "nets") == {"nets"}  # a learner makes no environment
    assert "nets" in chosen(*resumed, "--env", SPEC.environment.id, *settings)
    assert "nets" in chosen("--env", SPEC.environment.id, *settings, "--run-dir", str(run / "new"))


def test_train_passes_the_modules_of_its_settings_on(tmp_path: Path) -> None:
    words = ["--env", "corridor:Corridor-v0", "--wrap", "wrappers:step_costs", "--set", "policy.encoder=nets:Net"]
    spec = run_choice(train.train_parser().parse_args(words)).spec()
    assert (spec.environment, spec.policy.encoder) == (SPEC.environment, SPEC.policy.encoder)
    run_directory.write_config(tmp_path, spec)
    assert run_directory.read_config(tmp_path).environment.wrap == "wrappers:step_costs"
    options = local_run.actor_arguments(LocalRun(directory=tmp_path, spec=spec, started=0.0))
    assert options[-4:] == ("--allow-module", "corridor", "--allow-module", "wrappers")


def test_an_actor_allows_only_what_its_command_line_names(capsys: pytest.CaptureFixture[str]) -> None:
    parse = actor.parser().parse_args
    connect = ["--connect", "tcp/127.0.0.1:1"]
    assert actor.actor_options(parse(connect)).config(None).modules.allowed == frozenset()
    allowing = [*connect, "--allow-module", "corridor", "--allow-module", "my.wrappers"]
    modules = actor.actor_options(parse(allowing)).config(None).modules
    assert (modules.allowed, modules.source) == ({"corridor", "my.wrappers"}, "the learner")
    for wrong in ("corridor:Corridor-v0", "corridor.", "../corridor", "corridor.py"):
        with pytest.raises(SystemExit):
            parse([*connect, "--allow-module", wrong])
        assert "is not the name of a module: write my_module" in capsys.readouterr().err
