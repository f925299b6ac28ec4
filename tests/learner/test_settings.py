"""learner/run/settings.py: presets, assignments, and error messages of one line."""

import datetime
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daedalus.launch.run_choice import RunChoice, warn_of_unread
from daedalus.learner.run.run_directory import read_config, write_config
from daedalus.learner.run.settings import (
    SettingsError,
    assign,
    choose_algorithm,
    override,
    preset_names,
    read_preset,
    read_settings,
    run_spec,
    unmeasured_target,
    unread_settings,
)
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.messages import Welcome
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec

IMAGE, CELLS = ArraySpace(shape=(84, 84, 3), dtype="uint8"), ArraySpace(shape=(7, 7, 3), dtype="uint8")
NUMBERS = ArraySpace(shape=(4,), dtype="float32")
DISCRETE = {"action": DiscreteSpace(counts=(2,))}
CONTINUOUS = {"action": ContinuousSpace(low=(-1.0,), high=(1.0,))}
OF_LAYERS = "policy.hidden policy.activation"
OF_DISTRIBUTIONS = "policy.distribution policy.initial_std policy.state_dependent_std policy.mixture_components"


def settings(*assignments: str, **sections: Any) -> dict[str, Any]:
    made = {"environment": {"id": "Any-v0"}, **sections}
    override(made, assignments)
    return made


def error_message(*assignments: str, **sections: Any) -> str:
    """Return the error message of invalid settings, which is one line."""
    with pytest.raises(SettingsError) as caught:
        run_spec(settings(*assignments, **sections))
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---------------------------------------------------------------------------------------------- presets


def test_error_of_an_unknown_preset_suggests_similar_names_or_lists_all() -> None:
    with pytest.raises(SettingsError, match=r"unknown preset 'cartpoel': did you mean .*cartpole.*--env"):
        read_preset("cartpoel")
    with pytest.raises(SettingsError, match=rf"the presets are {', '.join(preset_names())}"):
        read_preset("zzz")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"], ids=["plain", "byte order mark"])
def test_toml_file_can_be_used_as_a_preset(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "own.toml"
    path.write_text('[environment]\nid = "Own-v0"\n', encoding)
    assert read_preset(str(path)) == {"environment": {"id": "Own-v0"}}


def test_environment_in_place_of_a_preset_is_shown_its_option() -> None:
    for name in ("CartPole-v1", "ALE/Pong-v5", "corridor:Corridor-v0"):
        with pytest.raises(SettingsError) as caught:
            read_preset(name)
        assert str(caught.value).startswith(f"unknown preset {name!r}: ")
        end = f"such as with: daedalus train --env {name} (in Python: daedalus.train(env={name!r}))"
        assert str(caught.value).endswith(end)


def test_run_directory_in_place_of_a_preset_is_shown_its_commands(tmp_path: Path) -> None:
    (tmp_path / "config.toml").touch()
    with pytest.raises(SettingsError) as caught:
        read_preset(str(tmp_path))
    assert str(caught.value) == (
        f"{tmp_path} is a run directory: continue it with `daedalus resume {tmp_path}`, or start a new run with its "
        f"settings with `daedalus train {tmp_path}/config.toml`"
    )


def test_setting_outside_of_a_section_is_refused(tmp_path: Path) -> None:
    for text in ("environment = 3", 'env_steps = 3\n[environment]\nid = "Own-v0"'):
        (tmp_path / "own.toml").write_text(text)
        with pytest.raises(SettingsError, match=r"own\.toml: \w+ is a value outside of the sections"):
            read_preset(str(tmp_path / "own.toml"))


def test_file_of_python_is_named_as_a_module() -> None:
    with pytest.raises(SettingsError, match=r"^folder/my_env\.py is a module, not a preset: .* as --env my_env:ID$"):
        read_preset("folder/my_env.py")


def test_unreadable_file_is_named_in_the_error(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"missing\.toml does not exist"):
        read_preset(str(tmp_path / "missing.toml"))
    for content in (b"= nonsense", b"a = '\xff'"):
        (tmp_path / "bad.toml").write_bytes(content)
        with pytest.raises(SettingsError, match=r"bad\.toml is not valid TOML"):
            read_settings(tmp_path / "bad.toml")


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
def test_value_is_parsed_as_toml_or_else_used_as_text(assignment: str, value: object) -> None:
    assert settings(assignment)["training"] == {"x": value}


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        ("training.learning_rate", True, "true, which is no number"),
        ("environment.frame_stack", np.True_, "true, which is no number"),
        ("environment.frame_stack", {"a": True}, "true, which is no number"),
        ("policy.hidden", [64, True], "true, which is no number"),
        ("environment.action_table", [[1.0], [False]], "false, which is no number"),
        ("policy.hidden", {64, 32}, "which has no order: write a list"),
        ("environment.action_table", [{1.0, 0.0}, [0.0, 1.0]], "which has no order: write a list"),
    ],
)
def test_value_that_pydantic_would_convert_to_another_is_refused(path: str, value: object, reason: str) -> None:
    chosen = settings()
    assign(chosen, path, value)
    with pytest.raises(SettingsError, match=rf"^setting {path} is .*{reason}"):
        run_spec(chosen)


def test_value_none_unsets_a_setting() -> None:
    assert settings("training.x=none", training={"x": 1, "y": 2})["training"] == {"y": 2}
    assert run_spec(settings("training.target_return=none", training={"target_return": 4.0})).training == (
        run_spec(settings()).training
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("True", True),
        ("False", False),
        ('"False"', "False"),  # a text, deliberately
        (".5", 0.5),
        ("1.", 1.0),
        ("1_000", 1000),
        ("0x10", 16),
        ("None", None),
        ("none", None),
        ("null", None),
        ("'none'", "none"),
        ("{none = true}", None),
        ("[True, None, {'a': .5}]", [True, None, {"a": 0.5}]),
        ('{"a": null, "b": true}', {"a": None, "b": True}),
        ("rgb_array", "rgb_array"),
        ("maps/a b.c", "maps/a b.c"),
        ("red,green", "red,green"),
        ("5#a", "5#a"),
        ("1.2.3", "1.2.3"),
        ("...", "..."),
        ("2024-01-01", "2024-01-01"),
        ("12:30:00", "12:30:00"),
    ],
)
@pytest.mark.parametrize("table", ["environment.kwargs", "environment.training_kwargs", "training.algorithm_kwargs"])
def test_argument_reaches_its_constructor_as_the_value_that_was_written(
    table: str, text: str, value: object, tmp_path: Path
) -> None:
    section, name = table.split(".")
    spec = run_spec(settings(f"{table}.x={text}", training={"algorithm": "my_module:Mine"}))
    write_config(tmp_path, spec)
    welcome = decode(encode(Welcome(run="r", learner_epoch=1, seed=1, spec=spec.for_actors())), LEARNER_LIMITS)
    assert isinstance(welcome, Welcome)
    for_actors = welcome.spec.learning_settings if section == "training" else welcome.spec
    for received in (spec, read_config(tmp_path), for_actors):
        found = getattr(getattr(received, section), name)["x"]
        assert (type(found), found) == (type(value), value)


@pytest.mark.parametrize(
    ("text", "correction"),
    [
        ("08", "write 8, or '\"08\"' for the text"),
        ("1__000", "write 1000, or "),
        ("FALSE", "write false, or '\"FALSE\"' for the text"),
        ("off", "write false, or '\"off\"' for the text"),
        ("yes", "write true, or "),
        ("Null", "write none, or "),
        ("8,8", "write [8,8] for a list, or '\"8,8\"' for the text"),
        ("True,False", "write [True,False] for a list, or "),
        ("[a, b]", 'write it as [8, true, "text"] or {size = 8, mode = "text"}'),
        ("{slippery=False}", 'write it as [8, true, "text"] or {size = 8, mode = "text"}'),
        ("(8,8)", "write a list, [8, 8]"),
        ("{1, 2}", "write a list, [1, 2]"),
        ("[2024-01-01]", 'write a text, "2024-01-01"'),
        ("nan", "write a finite number, or a text that the constructor reads"),
        ("-inf", "write a finite number, or a text that the constructor reads"),
        ("INFINITY", "write '\"INFINITY\"' for the text"),
        ("[" * 5000, "write it as "),
        ("[" * 80 + "]" * 80, "is nested too deeply"),
    ],
)
def test_text_that_looks_like_a_value_is_refused_as_an_argument_with_the_spelling_that_works(
    text: str, correction: str
) -> None:
    message = error_message(f"environment.kwargs.x={text}")
    assert "environment.kwargs.x" in message
    assert correction in message
    if message.endswith(" for the text"):
        quoted = message.rpartition("for the text")[0].split()[-1].strip("'")
        assert run_spec(settings(f"environment.kwargs.x={quoted}")).environment.kwargs["x"] == text


@pytest.mark.parametrize(
    ("value", "kept"), [(np.int64(3), 3), (np.float32(0.5), 0.5), (np.bool_(False), False), ("none", "none")]
)
def test_argument_of_a_program_is_kept(value: object, kept: object) -> None:
    made = settings()
    assign(made, "environment.kwargs.x", value)
    found = run_spec(made).environment.kwargs["x"]
    assert (type(found), found) == (type(kept), kept)


@pytest.mark.parametrize(
    ("value", "correction"),
    [
        ((8, 8), "write a list, [8, 8]"),
        ({8}, "write a list, [8]"),
        (np.zeros(2), "write a list, as by its method tolist()"),
        (Path("maps/a"), 'write a text, "maps/a"'),
        (datetime.date(2024, 1, 1), 'write a text, "2024-01-01"'),
        ({1: 2}, "write its keys as texts"),
        (b"x", "write a number, a text in quotation marks"),
        (math.inf, "write a finite number"),
    ],
)
def test_argument_that_no_file_can_express_is_refused(value: object, correction: str) -> None:
    for path, argument in (("x", value), ("x.list.0", {"list": [value]})):
        message = error_message(environment={"id": "A-v0", "kwargs": {"x": argument}})
        assert message.startswith(f"setting environment.kwargs.{path} is ")
        assert correction in message


def test_assignment_to_nested_tables_and_last_assignment_wins() -> None:
    made = settings("environment.kwargs.map.size=3", "environment.kwargs.map.size=4", "environment.kwargs.fast=true")
    assert made["environment"]["kwargs"] == {"map": {"size": 4}, "fast": True}


@pytest.mark.parametrize("assignment", ["training.x", "x=3", "=3", "", "training"])
def test_assignment_without_section_key_and_value_is_refused(assignment: str) -> None:
    with pytest.raises(SettingsError, match=r"write section\.key=value"):
        settings(assignment)


def test_assignment_below_a_value_is_refused() -> None:
    with pytest.raises(SettingsError, match="id is a value, not a section"):
        settings("environment.id.x=1")


# --------------------------------------------------------------------------------------- error messages


def test_setting_that_no_message_to_an_actor_can_hold_is_refused_by_name() -> None:
    def spec_of(rows: int) -> RunSpec:
        table = [[float(row), 0.5] for row in range(rows)]
        return run_spec(settings(environment={"id": "X-v0", "action_table": table}))

    welcome = Welcome(run="r" * 64, learner_epoch=2**62, seed=2**32, spec=spec_of(13_000).for_actors())
    assert decode(encode(welcome), LEARNER_LIMITS) == welcome
    for rows, size in ((14_000, "266,003"), (65_536, "1,245,189")):
        with pytest.raises(SettingsError) as caught:
            spec_of(rows)
        assert str(caught.value).startswith(f"environment.action_table has {size} bytes, too many to send to actors: ")
        assert "all settings together may have 253,952, and have " in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("assignment", "range_"),
    [
        ("training.discount_factor=1.5", "at least 0 and at most 1"),
        ("training.discount_factor=nan", "at least 0 and at most 1"),
        ("training.learning_rate=0", "above 0 and at most 1"),
        ("training.seed=4294967296", "at least 0 and below 4294967296"),
        ("collection.window=65", "at least 1 and at most 64"),
        ("training.env_steps=0", "at least 1"),
    ],
)
def test_value_out_of_range_error_names_the_range(assignment: str, range_: str) -> None:
    message, (name, _, value) = error_message(assignment), assignment.partition("=")
    assert message.startswith(f"setting {name} ")
    assert f"not {value}" in message
    assert f"(it must be {range_})" in message


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("training.learning_rte=0.1", "unknown setting training.learning_rte: did you mean training.learning_rate"),
        ("trainin.seed=1", "unknown setting trainin: did you mean training?"),
        ("environment.patience=9", "patience is of an earlier release: environment.no_reward_limit replaces it"),
        ("environment.backend=sketch", "backend is 'sketch', which is of an earlier release: 'fast' replaces it"),
        ("policy.zzz=1", "the settings are activation, codes, distribution, encoder, hidden"),
        (f"environment.kwargs.size={10**30}", "environment.kwargs cannot be sent to actors: "),
        *((f"training.target_return={value}", "setting training.target_return ") for value in ("nan", "inf")),
        ("training.value_coefficient=inf", "setting training.value_coefficient "),
        ("environment.reward_scale=inf", "setting environment.reward_scale "),
        ("service.queue_megabytes=inf", "setting service.queue_megabytes "),
        ("training.learning_rate=fast", "setting training.learning_rate should be"),
        ("training.algorithm=ppo", "one_step_sarsa, n_step_q, sac (did you mean appo?), not 'ppo'"),
        ("policy.hidden=64", "setting policy.hidden is 64, which is not a list: write policy.hidden=[64]"),
        # Without the quotes that a shell removed.
        ("environment.leave_out=mission", "not a list: write --set \"environment.leave_out=['mission']\""),
        ("environment.leave_out=[mission]", "not a list: write --set \"environment.leave_out=['mission']\""),
        ("policy.hidden=[64", "setting policy.hidden is '[64': the closing bracket is missing"),
        (
            "environment.leave_out=['a b']",
            "setting environment.leave_out.0 is 'a b', which is not valid. Components of the observation that the "
            'policy does not see, such as a text: `leave_out = ["mission"]`.',
        ),
        ("environment.wrap=foo", "setting environment.wrap is 'foo', which is not valid: write module:function"),
        ("environment.id=", "setting environment.id is empty"),
        ("lessons.start=1", "setting lessons.start does not say of what: write lessons.NAME.start"),
        ("lessons.speed=1", "setting lessons.speed is 1, and not one of its settings: write lessons.speed.above, "),
        ("policy.encoder=cnn", "setting policy.encoder is 'cnn', which is not valid. Encoder of"),
        ("policy.hidden=[64, 0]", "setting policy.hidden.1 should be"),
        # Of a setting of several types: that of the type that was meant.
        ("environment.frame_stack=0", "environment.frame_stack should be greater than or equal to 1, not 0"),
        ("environment.frame_stack.camera=0", "frame_stack.camera should be greater than or equal to 1, not 0"),
        ("environment.frame_stack=x", "setting environment.frame_stack should be a valid integer"),
        *(
            (f"environment.resize={value}", ": it must be a list of 2 numbers. Resize frames to")
            for value in ("84", "[84]", "[84, 84, 3]", "84x84", "{height = 84}")
        ),
    ],
)
def test_wrong_setting_is_refused_in_words_of_the_user(assignment: str, message: str) -> None:
    assert message in error_message(assignment)


def test_wrong_section_and_settings_that_do_not_go_together_are_refused() -> None:
    assert error_message(training=3).startswith("setting training should be")
    message = error_message("training.algorithm=a2c", "training.batch_rollouts=2")
    assert message == "training.batch_rollouts has no meaning for a2c: its batch is one rollout of every live actor"


@pytest.mark.parametrize(
    ("assignment", "end"),
    [
        ("policy.hidden=64,32", ": write policy.hidden=[64,32]"),
        ("training.exploration=0.1", ": write training.exploration=[0.1]"),
        ("environment.action_table=3", "is 3, which is not a list"),
        ("environment.action_table=[[1.0], 3]", "environment.action_table.1 is 3, which is not a list"),
    ],
)
def test_example_of_a_list_is_one_that_is_accepted(assignment: str, end: str) -> None:
    message = error_message(assignment)
    assert message.endswith(end)
    _, found, example = message.partition(": write ")
    if found:
        run_spec(settings(example))


def test_settings_without_an_environment_are_refused() -> None:
    with pytest.raises(SettingsError, match="setting environment is missing"):
        run_spec({})


def test_for_algorithm_settings_apply_only_to_the_chosen_algorithm() -> None:
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


def test_sac_replaces_the_settings_of_another_algorithm_and_keeps_its_own() -> None:
    settings = read_preset("hopper")
    choose_algorithm(settings, "sac")
    assert run_spec(settings).policy.distribution == "squashed_gaussian"
    assert settings["environment"]["id"] == "Hopper-v5"
    settings["policy"]["hidden"] = [32]  # such as in the config.toml of a run
    choose_algorithm(settings, "sac")
    assert settings["policy"]["hidden"] == [32]


@pytest.mark.parametrize(
    ("settings", "unread", "read"),
    [
        ({}, "training.passes training.trace_clip policy.memory_units training.n_step", "training.trace_lambda"),
        ({"training": {"algorithm": "appo"}}, "training.rho_clip training.n_step", "training.passes"),
        (
            {"training": {"algorithm": "appo", "exploration": [0.1]}},
            "training.trace_clip training.proximal_policy",
            "training.rho_clip training.exploration_env_steps",
        ),
        ({"training": {"algorithm": "a2c"}}, "training.max_policy_lag training.exploration_env_steps", ""),
        (
            {"policy": {"distribution": "kumaraswamy"}},
            "policy.initial_std policy.state_dependent_std league.target_win_rate",
            "policy.distribution policy.hidden training.max_policy_lag",
        ),
        (
            {
                "environment": {"id": "a:b", "backend": "pettingzoo"},
                "league": {"target_opponent": "random"},
                "policy": {"distribution": "gaussian_mixture"},
            },
            "policy.state_dependent_std",
            "policy.initial_std policy.mixture_components league.target_win_rate",
        ),
        ({"training": {"algorithm": "one_step_q"}}, "training.trace_lambda", "training.target_period"),
        ({"training": {"optimizer": "rmsprop"}}, "policy.mixture_components", "training.rmsprop_decay"),
        ({"policy": {"memory": "gru"}}, "policy.separate_value_encoder", "policy.memory_units"),
        ({"training": {"algorithm": "my:Algorithm"}}, "", "training.passes training.n_step"),
        (
            {
                "training": {"algorithm": "sac"},
                "policy": {"distribution": "squashed_gaussian", "state_dependent_std": True},
            },
            "training.entropy_bonus training.passes policy.separate_value_encoder",
            "training.n_step",
        ),
    ],
)
def test_settings_that_nothing_reads_are_known(settings: dict[str, Any], unread: str, read: str) -> None:
    training = {"algorithm": "a3c", **settings.get("training", {})}
    made = run_spec({"environment": {"id": "CartPole-v1"}, **settings, "training": training})
    found = unread_settings(made)
    assert set(unread.split()) <= found
    assert not set(read.split()) & found
    for name in found:  # all exist
        section, key = name.split(".")
        assert hasattr(getattr(made, section), key)


@pytest.mark.parametrize(
    ("settings", "observations", "actions", "unread"),
    [
        ({}, (IMAGE,), DISCRETE, f"{OF_DISTRIBUTIONS} {OF_LAYERS} policy.normalize_observations"),
        ({}, (IMAGE, NUMBERS), CONTINUOUS, ""),
        ({"encoder": "mlp"}, (IMAGE,), CONTINUOUS, ""),
        ({"encoder": "own:Encoder"}, (NUMBERS,), DISCRETE, OF_DISTRIBUTIONS),
        ({"encoder": "small"}, (NUMBERS,), CONTINUOUS, OF_LAYERS),
        ({"codes": {"0": [3]}}, (CELLS,), CONTINUOUS, ""),
        ({"codes": {"0": [3]}, "encoder": "grid"}, (CELLS,), CONTINUOUS, "policy.normalize_observations"),
    ],
)
def test_settings_of_a_network_that_nothing_reads_depend_on_the_spaces(
    settings: dict[str, Any], observations: tuple[ArraySpace, ...], actions: Any, unread: str
) -> None:
    made = run_spec({"environment": {"id": "A-v0"}, "policy": settings})
    spaces = Spaces(observations={str(number): each for number, each in enumerate(observations)}, actions=actions)
    assert unread_settings(made, spaces) == unread_settings(made) | {*unread.split()}


@pytest.mark.parametrize(
    ("league", "is_measured"),
    [
        ({}, True),
        ({"rating_share": 0.0}, True),
        ({"target_opponent": "random"}, True),
        ({"target_opponent": "random", "rating_share": 0.0}, False),
        ({"target_opponent": "random", "rating_share": 0.0, "opponents": {"random": 0.1}}, True),
        (
            {
                "target_opponent": "random",
                "rating_share": 0.0,
                "opponents": {"random": 0.1},
                "rating_actions": "greedy",
            },
            False,
        ),
        ({"target_rating": 100.0, "rating_share": 0.0}, True),
        ({"target_rating": 100.0, "rating_share": 0.0, "past_share": 0.0}, False),
    ],
)
def test_a_target_for_which_no_match_counts_is_refused(league: dict[str, Any], is_measured: bool) -> None:
    made = run_spec({"environment": {"id": "a:b", "backend": "pettingzoo"}, "league": league})
    problem = unmeasured_target(made)
    assert (problem == "") == is_measured
    assert is_measured or "no match counts for it: set league.rating_share above 0" in problem


def test_settings_of_the_user_that_nothing_reads_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "own.toml").write_text(
        '[environment]\nid = "CartPole-v1"\n[training]\nalgorithm = "a2c"\nclip_range = 0.4\nrho_clip = 1.0'
    )
    for choice in (
        RunChoice(
            env="CartPole-v1",
            algorithm="a2c",
            assignments=["training.clip_range=0.3"],
            settings={"training.passes": 2, "training.seed": 2},
        ),
        RunChoice(env="CartPole-v1", algorithm="a2c", assignments=["training.learning_rate=0.1"]),
        RunChoice(preset=str(tmp_path / "own.toml")),  # its rho_clip is the default
        RunChoice(preset="pong"),
    ):
        warn_of_unread(choice.names(), choice.spec())
    start = "no effect in this run (algorithm a2c): training."
    assert caplog.messages == [f"{start}clip_range, training.passes", f"{start}clip_range"]


def test_settings_of_demonstrations_that_a_run_has_not_are_named(caplog: pytest.LogCaptureFixture) -> None:
    choice = RunChoice(env="CartPole-v1", algorithm="appo", assignments=["training.cloning_weight=0.2"])
    for demonstrations in (True, False):
        warn_of_unread(choice.names(), choice.spec(), demonstrations=demonstrations)
    assert caplog.messages == ["no effect in this run (algorithm appo): training.cloning_weight"]


@pytest.mark.parametrize("table", [3, {"impala": 3}, {"impala": {"training": 3}}])
def test_for_algorithm_that_is_not_a_table_of_sections_is_refused(table: object) -> None:
    with pytest.raises(SettingsError, match="for_algorithm"):
        choose_algorithm({"training": {"algorithm": "impala"}, "for_algorithm": table}, None)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"a3d": {}}, r"^for_algorithm\.a3d must be one of .* \(did you mean a3c\?\)"),
        ({"a3c": {"trainin": {}}}, r"unknown setting for_algorithm\.a3c\.trainin: did you mean .*\.training\?"),
        (
            {"a3c": {"training": {"learning_rat": 0.1}}},
            r"unknown setting for_algorithm\.a3c\.training\.learning_rat: did you mean .*\.training\.learning_rate",
        ),
    ],
)
def test_misspelt_for_algorithm_is_refused_whatever_the_algorithm_is(tables: dict[str, Any], message: str) -> None:
    for algorithm in (None, "a3c", "impala"):
        with pytest.raises(SettingsError, match=message):
            choose_algorithm({"for_algorithm": tables}, algorithm)
    choose_algorithm({"for_algorithm": {"mine:Algorithm": {"environment": {"id": "Any-v0"}}}}, None)


@pytest.mark.parametrize("name", preset_names())
@pytest.mark.parametrize("algorithm", ["a2c", "a3c", "impala"])
def test_every_preset_is_valid_with_every_algorithm(name: str, algorithm: str) -> None:
    settings = read_preset(name)
    choose_algorithm(settings, algorithm)
    assert run_spec(settings).training.algorithm == algorithm
