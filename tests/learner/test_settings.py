"""learner/run/settings.py: what makes a run, and one line that helps where it makes none."""

from pathlib import Path
from typing import Any

import pytest

from daedalus.learner.run.settings import (
    SettingsError,
    choose_algorithm,
    override,
    preset_names,
    read_file,
    read_preset,
    run_spec,
)


def settings(*assignments: str, **sections: Any) -> dict[str, Any]:
    made = {"environment": {"id": "Any-v0"}, **sections}
    override(made, assignments)
    return made


def complaint(*assignments: str, **sections: Any) -> str:
    """What is said of the settings: one line."""
    with pytest.raises(SettingsError) as caught:
        run_spec(settings(*assignments, **sections))
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---------------------------------------------------------------------------------------------- presets


def test_cartpole_is_a_preset() -> None:
    assert "cartpole" in preset_names()
    assert read_preset("cartpole")["environment"]["id"] == "CartPole-v1"


def test_an_unknown_preset_is_answered_with_the_nearest() -> None:
    with pytest.raises(SettingsError, match=r"unknown preset 'cartpoel': did you mean .*cartpole.*--env"):
        read_preset("cartpoel")


def test_a_preset_like_no_other_is_answered_with_all_of_them() -> None:
    with pytest.raises(SettingsError, match=rf"the presets are {', '.join(preset_names())}"):
        read_preset("zzz")


def test_a_file_is_as_good_as_a_preset(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text('[environment]\nid = "Own-v0"\n')
    assert read_preset(str(path)) == {"environment": {"id": "Own-v0"}}


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"missing\.toml: No such file"):
        read_preset(str(tmp_path / "missing.toml"))
    for content in (b"= nonsense", b"a = '\xff'"):
        (tmp_path / "bad.toml").write_bytes(content)
        with pytest.raises(SettingsError, match=r"bad\.toml is not valid TOML"):
            read_file(tmp_path / "bad.toml")


# ---------------------------------------------------------------------------------------------- --set


@pytest.mark.parametrize(
    ("assignment", "value"),
    [
        ("training.x=3", 3),
        ("training.x=0.5", 0.5),
        ("training.x=1e-3", 1e-3),
        ("training.x=true", True),
        ("training.x=[64, 32]", [64, 32]),
        ("training.x='impala'", "impala"),
        ("training.x=impala", "impala"),
        ("training.x=a=b", "a=b"),
        ("training.x=two words", "two words"),
        ("training.x=", ""),
        (" training.x =3", 3),
    ],
)
def test_a_value_is_toml_or_else_plain_text(assignment: str, value: object) -> None:
    assert settings(assignment)["training"] == {"x": value}


def test_none_takes_a_setting_away() -> None:
    assert settings("training.x=none", training={"x": 1, "y": 2})["training"] == {"y": 2}
    assert run_spec(settings("training.target_return=none", training={"target_return": 4.0})).training == (
        run_spec(settings()).training
    )


def test_assignments_reach_into_nested_tables_and_the_last_one_holds() -> None:
    made = settings("environment.kwargs.map.size=3", "environment.kwargs.map.size=4", "environment.kwargs.fast=true")
    assert made["environment"]["kwargs"] == {"map": {"size": 4}, "fast": True}


@pytest.mark.parametrize("assignment", ["training.x", "x=3", "=3", "", "training"])
def test_an_assignment_without_section_key_and_value_is_refused(assignment: str) -> None:
    with pytest.raises(SettingsError, match=r"write section\.key=value"):
        settings(assignment)


def test_an_assignment_below_a_value_is_refused() -> None:
    with pytest.raises(SettingsError, match="id is a value, not a section"):
        settings("environment.id.x=1")


# ------------------------------------------------------------------------------------------- complaints


def test_an_unknown_setting_is_answered_with_the_nearest() -> None:
    said = complaint("training.learning_rte=0.1")
    assert said.startswith("unknown setting training.learning_rte: did you mean learning_rate")
    assert complaint("trainin.seed=1") == "unknown setting trainin: did you mean training?"


def test_an_unknown_setting_like_no_other_is_answered_with_all_of_its_section() -> None:
    assert "the settings are activation, encoder, hidden" in complaint("policy.zzz=1")


@pytest.mark.parametrize(
    ("assignment", "range_"),
    [
        ("training.discount_factor=1.5", "at least 0 and at most 1"),
        ("training.discount_factor=nan", "at least 0 and at most 1"),
        ("training.learning_rate=0", "above 0 and at most 1"),
        ("training.seed=4294967296", "at least 0 and below 4.29497e+09"),
        ("collection.window=65", "at least 1 and at most 64"),
        ("training.env_steps=0", "at least 1"),
    ],
)
def test_a_value_out_of_range_is_named_with_the_range(assignment: str, range_: str) -> None:
    said, (name, _, value) = complaint(assignment), assignment.partition("=")
    assert said.startswith(f"setting {name} ")
    assert f"not {value}" in said
    assert f"(it must be {range_})" in said


@pytest.mark.parametrize(
    "assignment",
    [
        "training.target_return=nan",
        "training.value_coefficient=inf",
        "environment.reward_scale=inf",
        "service.queue_megabytes=inf",
    ],
)
def test_a_value_that_is_not_finite_is_refused(assignment: str) -> None:
    assert complaint(assignment).startswith(f"setting {assignment.partition('=')[0]} ")


def test_a_value_of_another_kind_is_refused() -> None:
    assert complaint("training.learning_rate=fast").startswith("setting training.learning_rate should be")
    assert "one of a2c, a3c, impala, appo, not 'ppo'" in complaint("training.algorithm=ppo")
    assert complaint("policy.hidden=[64, 0]").startswith("setting policy.hidden.1 should be")
    assert complaint(training=3).startswith("setting training should be")


def test_a_run_without_an_environment_is_refused() -> None:
    with pytest.raises(SettingsError, match="setting environment is missing"):
        run_spec({})


def test_a_batch_size_for_a2c_is_refused_with_the_reason() -> None:
    said = complaint("training.algorithm=a2c", "training.batch_rollouts=2")
    assert said == "training.batch_rollouts has no meaning for a2c: its batch is one rollout of every live actor"


def test_a_preset_keeps_settings_for_one_algorithm() -> None:
    def preset() -> dict:
        return {
            "environment": {"id": "CartPole-v1"},
            "training": {"algorithm": "impala", "batch_rollouts": 3},
            "for_algorithm": {"a2c": {"training": {"batch_rollouts": "none"}, "collection": {"actors": 7}}},
        }

    for algorithm, batch, actors in (("a2c", None, 7), (None, 3, 2), ("a3c", 3, 2)):
        settings = preset()
        choose_algorithm(settings, algorithm)
        spec = run_spec(settings)
        assert (spec.training.batch_rollouts, spec.collection.actors) == (batch, actors)
        assert spec.training.algorithm == (algorithm or "impala")


@pytest.mark.parametrize("table", [3, {"impala": 3}, {"impala": {"training": 3}}])
def test_a_table_for_an_algorithm_that_is_none_is_told(table: object) -> None:
    with pytest.raises(SettingsError, match="for_algorithm"):
        choose_algorithm({"training": {"algorithm": "impala"}, "for_algorithm": table}, None)


@pytest.mark.parametrize("name", preset_names())
@pytest.mark.parametrize("algorithm", ["a2c", "a3c", "impala"])
def test_every_preset_makes_a_run_with_every_algorithm(name: str, algorithm: str) -> None:
    settings = read_preset(name)
    choose_algorithm(settings, algorithm)
    assert run_spec(settings).training.algorithm == algorithm
