"""Test of analysis/sweep_plan.py."""

import argparse
from dataclasses import replace
from pathlib import Path

import pytest
from planning import finish, planner

from daedalus.analysis.sweep_plan import (
    Choices,
    PlannedRun,
    Range,
    has_begun,
    is_done,
    point_name,
    read_axis,
    split_values,
)
from daedalus.cli.commands.train import train_parser
from daedalus.cli.settings_arguments import run_choice
from daedalus.learner.run.run_directory import SUMMARY
from daedalus.learner.run.settings import SettingsError


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("1,5,20", ["1", "5", "20"]),
        ("[64,64],[32]", ["[64,64]", "[32]"]),
        ("[[0.0, 1.0], [1.0, 0.5]] , none", ["[[0.0, 1.0], [1.0, 0.5]]", "none"]),
        ('"a,b",c', ['"a,b"', "c"]),
        ("{x = 1, y = 2},{}", ["{x = 1, y = 2}", "{}"]),
        ("tanh", ["tanh"]),
    ],
)
def test_values_end_at_commas_outside_of_brackets(text: str, values: list[str]) -> None:
    assert split_values(text) == values


def test_a_list_of_values() -> None:
    axis = read_axis("collection.rollout_length = 1,5,20,64")
    assert axis == Choices(key="collection.rollout_length", values=("1", "5", "20", "64"))


@pytest.mark.parametrize(
    ("text", "low", "high", "whole", "log"),
    [
        ("training.learning_rate=1e-4..1e-2", 1e-4, 1e-2, False, True),
        ("training.discount_factor=0.9..0.999", 0.9, 0.999, False, False),
        ("collection.rollout_length=4..64", 4, 64, True, True),
        ("collection.rollout_length=4..40", 4, 40, True, False),
        ("training.entropy_bonus=0.0..0.1", 0.0, 0.1, False, False),
        ("environment.kwargs.size=-1..1", -1, 1, True, False),
        ("environment.kwargs.size=-1..1.0", -1, 1, False, False),
        ("training.entropy_bonus=0..1", 0, 1, False, False),
        ("training.target_return=0..1", 0, 1, False, False),
        ("league.opponents.my_bots:Greedy.v1=0..1", 0, 1, False, False),
    ],
)
def test_a_range_is_logarithmic_beyond_a_factor_of_10(
    text: str, low: float, high: float, whole: bool, log: bool
) -> None:
    axis = read_axis(text)
    assert axis == Range(key=text.partition("=")[0], low=low, high=high, whole=whole)
    assert isinstance(axis, Range)
    assert axis.log is log


def test_a_value_of_a_range_is_short_and_inside() -> None:
    axis = Range(key="a.b", low=0.00123456, high=0.0987654, whole=False)
    assert axis.written(0.0034567891) == "0.003457"
    assert axis.written(0.09876539) == "0.0987654"  # rounded, it would be beyond the end
    assert Range(key="a.b", low=4, high=64, whole=True).written(5) == "5"
    assert Range(key="a.b", low=1e6, high=1e6 + 1, whole=False).written(1_000_000.25) == "1000000.25"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rollout_length=1,2", "write section.key=value,value"),
        ("collection.rollout_length", "write section.key=value,value"),
        ("collection.rollout_length=", "write section.key=value,value"),
        ("colection.rollout_length=1,2", "there is no section 'colection'"),
        ("collection.rollout_length=1,,2", "a value is empty"),
        ("collection.rollout_length=5,20,5", "the value 5 is there twice"),
        ("training.learning_rate=1e-3,0.001", r"the value 0\.001 is there twice"),
        ("training.learning_rate=1e-2..1e-4", "the range is empty: write the lower end first"),
        ("training.learning_rate=1..1e999", "an end of the range is too large"),
        ("environment.kwargs.x=False,false", "the value false is there twice"),
        ("environment.kwargs.x=FALSE,true", "FALSE would be a text: write false"),
        ("environment.kwargs.x=08,9", "08 would be a text: write 8"),
        ("training.seed=1,2", "use --seeds N"),
        ("environment.id=A-v0,B-v0", "a sweep has one environment"),
    ],
)
def test_bad_input_is_one_line(text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message) as error:
        read_axis(text)
    assert "\n" not in str(error.value)


def test_underscores_are_for_numbers_between_digits_only() -> None:
    assert read_axis("training.batch_rollouts=1_0..2_0") == Range(
        key="training.batch_rollouts", low=10.0, high=20.0, whole=True
    )
    assert read_axis("training.batch_rollouts=1_..2") == Choices(key="training.batch_rollouts", values=("1_..2",))


def as_trained(run: PlannedRun) -> argparse.Namespace:
    """Return the options that `daedalus train` reads from the command line of a run."""
    command, *words = run.words
    assert command == "train"
    return train_parser().parse_args(words)


def test_the_command_line_of_a_run_gives_the_settings_that_are_planned(tmp_path: Path) -> None:
    options = ["--env-steps", "5000", "--set", "policy.hidden=[32]", "--log", "wandb", "--log", "mlflow"]
    point = {"collection.rollout_length": "5", "training.learning_rate": "1e-3"}
    first, second = planner(tmp_path, *options).runs("n", point, [3, 4])
    assert [run.directory for run in (first, second)] == [tmp_path / "n_seed-3", tmp_path / "n_seed-4"]
    parsed = as_trained(second)
    assert parsed.run_dir == second.directory
    assert parsed.log == ["wandb", "mlflow"]
    assert run_choice(parsed).spec() == second.spec
    assert second.spec.training.seed == 4
    assert second.spec.training.env_steps == 5000
    assert second.spec.policy.hidden == (32,)
    assert (second.spec.collection.rollout_length, second.spec.training.learning_rate) == (5, 1e-3)


def test_an_algorithm_brings_the_settings_of_its_preset(tmp_path: Path) -> None:
    (run,) = planner(tmp_path).runs("a3c", {"training.algorithm": "a3c"}, [1])
    assert run.spec.collection.rollout_length == 16  # of the preset's for_algorithm table
    assert run_choice(as_trained(run)).spec() == run.spec


def test_settings_that_are_not_valid_are_refused_before_any_run(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"collection\.rollout_length"):
        planner(tmp_path).runs("n", {"collection.rollout_length": "-1"}, [1])
    with pytest.raises(SettingsError, match=r"did you mean collection\.rollout_length\?"):
        planner(tmp_path).runs("n", {"collection.rolout_length": "5"}, [1])
    with pytest.raises(SettingsError, match=r"evaluation\.final_episodes: at least 1"):
        planner(tmp_path).runs("n", {"evaluation.final_episodes": "0"}, [1])


@pytest.mark.parametrize(
    ("point", "name"),
    [
        ({"a.rollout_length": "5", "b.learning_rate": "1e-3"}, "rollout_length-5_learning_rate-1e-3"),
        ({"policy.hidden": "[64, 64]"}, "hidden-64x64"),
        ({"policy.hidden": "[64]"}, "hidden-64x"),
        ({}, ""),
    ],
)
def test_folders_have_the_names_of_the_values(point: dict[str, str], name: str) -> None:
    assert point_name(point) == name


def test_different_values_have_different_names_without_special_characters() -> None:
    values = ["a/b", "a-b", "../x", "[a, b]", "m:C", "x" * 500, "y" * 500, "5", "[5]", "[5,5]", "55"]
    names = [point_name({"a.b": value}) for value in values]
    assert len(set(names)) == len(values)
    assert all("/" not in name and " " not in name and len(name) < 150 for name in names)


def test_a_run_is_done_when_it_was_evaluated(tmp_path: Path) -> None:
    (run,) = planner(tmp_path).runs("", {}, [1])
    assert run.name == "seed-1"
    assert (has_begun(run), is_done(run)) == (False, False)
    finish(run)
    assert (has_begun(run), is_done(run)) == (True, True)
    (run.directory / SUMMARY).write_text('{"finished": true, "evaluation": null}')
    assert (has_begun(run), is_done(run)) == (True, False)
    (run.directory / SUMMARY).write_text("")  # as a machine that crashes may leave it
    assert (has_begun(run), is_done(run)) == (True, False)
    assert run.resume_words == ("resume", str(run.directory))


def test_a_run_that_was_begun_with_other_settings_is_refused(tmp_path: Path) -> None:
    (run,) = planner(tmp_path).runs("", {}, [1])
    finish(run)
    planner(tmp_path).runs("", {}, [1])
    with pytest.raises(SettingsError) as error:
        planner(tmp_path, "--env-steps", "7000").runs("", {}, [1])
    assert str(error.value) == (
        f"{run.directory} was begun with other settings (training.env_steps is 1500000, and not 7000): "
        "choose another --folder, or remove this one"
    )


def test_a_run_that_was_begun_with_a_lesson_is_no_run_without_one(tmp_path: Path) -> None:
    task = ("--set", "environment.parameters.low=-0.05")
    (run,) = planner(tmp_path, *task, "--set", "lessons.low.between=[-0.1, 0.0]").runs("", {}, [1])
    finish(run)
    with pytest.raises(SettingsError, match=r"other settings \(lessons\.low is \{.*\}, and not None\)"):
        planner(tmp_path, *task).runs("", {}, [1])


def test_a_run_that_has_recorded_the_package_of_its_environment_has_the_same_settings(tmp_path: Path) -> None:
    (run,) = planner(tmp_path).runs("", {}, [1])
    environment = run.spec.environment.model_copy(update={"package": "gymnasium==1.0"})
    finish(replace(run, spec=run.spec.model_copy(update={"environment": environment})))
    (again,) = planner(tmp_path).runs("", {}, [1])
    assert is_done(again)
    with pytest.raises(SettingsError, match=r"environment\.package is gymnasium==1\.0, and not gymnasium==2\.0"):
        planner(tmp_path).runs("", {"environment.package": "gymnasium==2.0"}, [1])
