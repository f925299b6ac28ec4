"""Test of cli/settings_arguments.py: what a command line makes of the settings."""

import pytest

from daedalus.cli.settings_arguments import learner_parser, resolve
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError


def test_two_environments_are_refused() -> None:
    words = ["--env", "CartPole-v1", "--set", "environment.id=Acrobot-v1"]
    with pytest.raises(SettingsError, match=r"--env CartPole-v1 and environment.id=Acrobot-v1 are two environments"):
        resolve(learner_parser().parse_args(words))
    spec, _ = resolve(learner_parser().parse_args([*words[:3], "environment.id=CartPole-v1"]))
    assert spec.environment.id == "CartPole-v1"


@pytest.mark.parametrize(("name", "named"), [("config.toml", "Acrobot-v1"), ("mine.toml", "mine")])
def test_a_repeated_config_is_named_after_its_environment(
    tmp_path_factory: pytest.TempPathFactory, name: str, named: str
) -> None:
    folder = tmp_path_factory.mktemp("run")
    spec, _ = resolve(learner_parser().parse_args(["--env", "Acrobot-v1", "--seed", "5"]))
    run_directory.write_config(folder, spec)
    (folder / run_directory.CONFIG).rename(folder / name)
    again, directory = resolve(learner_parser().parse_args([str(folder / name)]))
    assert again == spec
    assert directory.name.startswith(f"{named}-appo-s5-")


def test_default_settings_of_a_policy_with_memory_have_fewer_updates_unless_they_are_chosen() -> None:
    words = ["--env", "CartPole-v1", "--set", "policy.memory=gru"]
    spec, _ = resolve(learner_parser().parse_args(words))
    assert (spec.training.passes, spec.training.minibatches, spec.collection.rollout_length) == (4, 4, 32)
    spec, _ = resolve(learner_parser().parse_args([*words, "--set", "training.passes=2"]))
    assert (spec.training.passes, spec.training.minibatches) == (2, 4)
    spec, _ = resolve(learner_parser().parse_args(words[:2]))
    assert (spec.training.passes, spec.collection.rollout_length) == (10, 128)
