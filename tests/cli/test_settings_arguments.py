"""Test of cli/settings_arguments.py: what a command line makes of the settings."""

import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from daedalus.cli.commands.learner import learner_options, parser
from daedalus.cli.commands.train import resume_parser, train_parser
from daedalus.cli.settings_arguments import run_choice
from daedalus.launch import learner_process
from daedalus.launch.learner_process import ChosenRun, LearnerNetwork, LearnerProcess, choose_run
from daedalus.launch.logs import LogOptions
from daedalus.launch.process_lifecycle import BAD_USAGE, FAILED
from daedalus.launch.role_training import shared_settings
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run import run_directory
from daedalus.learner.run.default_settings import default_settings
from daedalus.learner.run.run_lock import RunInUseError
from daedalus.learner.run.settings import DeviceError, SettingsError
from daedalus.policy.user_modules import NetworkError
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.transport.interface import TransportError


def spec_of(*words: str) -> RunSpec:
    return run_choice(parser().parse_args(words)).spec()


def chosen(*words: str) -> ChosenRun:
    return choose_run(learner_options(parser().parse_args(words), 0.0, Path()))


RATES = {"impala": 0.25, "appo": 0.5, "a3c": 0.125}


def test_two_environments_are_refused() -> None:
    words = ["--env", "CartPole-v1", "--set", "environment.id=Acrobot-v1"]
    with pytest.raises(SettingsError, match=r"--env CartPole-v1 and environment.id=Acrobot-v1 are two environments"):
        spec_of(*words)
    spec = spec_of(*[*words[:3], "environment.id=CartPole-v1"])
    assert spec.environment.id == "CartPole-v1"


@pytest.mark.parametrize(
    ("option", "value", "other", "setting"),
    [
        ("--env-steps", "100000", "200000", "training.env_steps"),
        ("--seed", "1", "2", "training.seed"),
        ("--actors", "1", "2", "collection.actors"),
        ("--algorithm", "a2c", "appo", "training.algorithm"),
        ("--wrap", "a:b", "a:c", "environment.wrap"),
        ("--wrap", "a:b", "none", "environment.wrap"),
    ],
)
def test_two_values_of_one_setting_are_refused(option: str, value: str, other: str, setting: str) -> None:
    words = ["--env", "CartPole-v1", option, value, "--set"]
    with pytest.raises(SettingsError, match=rf"{option} {value} and {setting}={other} are two values: leave one"):
        spec_of(*words, f"{setting}={other}")
    section, key = setting.split(".")
    assert str(getattr(getattr(spec_of(*words, f"{setting}={value}"), section), key)) == value


def test_a_preset_and_an_environment_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"^leave out one of cartpole and --env CartPole-v1$"):
        spec_of("cartpole", "--env", "CartPole-v1")
    with pytest.raises(SettingsError, match=r"^name a preset \(acrobot, .*\) or an environment with --env ID$"):
        spec_of()


@pytest.mark.parametrize("text", ["", "[training]\nenv_steps = 3\n", "[environment]\nbackend = 'fast'"])
def test_a_file_without_an_environment_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "own.toml").write_text(text)
    with pytest.raises(SettingsError, match=r"^setting environment(\.id)? is missing: add it$"):
        spec_of(str(tmp_path / "own.toml"))


@pytest.mark.parametrize(("text", "number"), [("1e6", 1_000_000), ("1_000_000", 1_000_000), ("25", 25), ("2.5e1", 25)])
def test_env_steps_may_be_written_as_any_whole_number(text: str, number: int) -> None:
    for make, words in ((parser, []), (train_parser, []), (resume_parser, ["run"])):
        assert make().parse_args([*words, "--env-steps", text]).env_steps == number


@pytest.mark.parametrize("text", ["1.5", "1e-1", "inf", "nan", "many", ""])
def test_env_steps_that_are_no_whole_number_are_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        train_parser().parse_args(["cartpole", f"--env-steps={text}"])
    assert f"argument --env-steps: {text!r} is not a whole number" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "named"), [("config.toml", "Acrobot-v1"), ("mine.toml", "mine")])
def test_a_repeated_config_is_named_after_its_environment(
    tmp_path_factory: pytest.TempPathFactory, name: str, named: str
) -> None:
    folder = tmp_path_factory.mktemp("run")
    spec = spec_of("--env", "Acrobot-v1", "--seed", "5")
    run_directory.write_config(folder, spec)
    (folder / run_directory.CONFIG).rename(folder / name)
    choice = run_choice(parser().parse_args([str(folder / name)]))
    assert choice.spec() == spec
    assert choice.directory(spec).name.startswith(f"{named}-appo-s5-")


@pytest.mark.parametrize("algorithm", ["a2c", "n_step_q"])
def test_an_algorithm_that_set_chooses_brings_the_settings_of_its_preset(algorithm: str) -> None:
    words = ["cartpole", "--seed", "3", "--set", "collection.rollout_length=7"]
    chosen = spec_of(*words, "--algorithm", algorithm)
    also = spec_of(*words, "--set", f"training.algorithm={algorithm}")
    assert also == chosen
    assert also.training.algorithm == algorithm
    assert also.collection.rollout_length == 7


def test_a_file_without_an_algorithm_has_the_settings_for_the_default_one(tmp_path: Path) -> None:
    tables = "".join(f"[for_algorithm.{name}.training]\nlearning_rate = {rate}\n" for name, rate in RATES.items())
    (tmp_path / "own.toml").write_text("[environment]\nid = 'CartPole-v1'\n" + tables)
    spec = spec_of(str(tmp_path / "own.toml"))
    assert spec.training.learning_rate == RATES[spec.training.algorithm]


def test_an_algorithm_that_is_no_text_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text("[environment]\nid = 'CartPole-v1'\n[training]\nalgorithm = ['a2c']\n")
    with pytest.raises(SettingsError, match=r"^setting training.algorithm should be a valid string, not \['a2c'\]"):
        spec_of(str(tmp_path / "own.toml"))


def test_default_settings_of_a_policy_with_memory_have_fewer_updates_unless_they_are_chosen() -> None:
    words = ["--env", "CartPole-v1", "--set", "policy.memory=gru"]
    spec = spec_of(*words)
    assert (spec.training.passes, spec.training.minibatches, spec.collection.rollout_length) == (4, 8, 32)
    assert (spec.policy.memory_units, spec.training.curiosity) == (64, 1.0)
    spec = spec_of(*words, "--algorithm", "a3c", "--set", "collection.upload=gradients")
    assert spec.training.curiosity == 0.0  # which gradients do not tell
    spec = spec_of(*words, "--set", "training.passes=2")
    assert (spec.training.passes, spec.training.minibatches) == (2, 8)
    spec = spec_of(*(words[:2]))
    assert (spec.training.passes, spec.collection.rollout_length) == (10, 128)


def test_a_learner_that_resumes_changes_the_settings_that_its_command_line_names(tmp_path: Path) -> None:
    spec = spec_of("cartpole", "--set", "training.learning_rate=0.5")
    environment = spec.environment.model_copy(update={"package": "gymnasium==1.0.0"})  # found when the run began
    spec = spec.model_copy(update={"environment": environment})
    run_directory.create(tmp_path / "run", spec)

    def resumed(*words: str) -> ChosenRun:
        return chosen(*words, "--run-dir", str(tmp_path / "run"), "--resume")

    same = ("cartpole", "--set", "training.learning_rate=0.5")
    for words in ((), same, ("--env", "CartPole-v1")):
        assert (resumed(*words).spec, resumed(*words).changed) == (spec, [])
        longer = resumed(*words, "--env-steps", "9e6")
        assert longer.spec.training == spec.training.model_copy(update={"env_steps": 9_000_000})
        assert longer.changed == ["training.env_steps"]
    with pytest.raises(SettingsError, match="--reset-statistics needs --resume"):
        chosen("cartpole", "--reset-statistics")
    with pytest.raises(SettingsError, match=r"continue the run with `daedalus learner --resume --run-dir .*/run`, or"):
        chosen("cartpole", "--run-dir", str(tmp_path / "run"))
    for words, names in (
        (("--seed", "9"), "training.seed"),
        (("cartpole", "--algorithm", "a2c", "--set", "policy.hidden=[3]"), "policy.hidden, training.algorithm.*"),
        (("cartpole",), "training.learning_rate"),
        (("--env", "Acrobot-v1"), "environment.id"),
    ):
        with pytest.raises(SettingsError, match=rf"^the run in .*/run has other settings \({names}\): leave out"):
            resumed(*words)


def test_a_learner_shows_the_lag_in_batches_of_the_settings_for_its_spaces(monkeypatch: pytest.MonkeyPatch) -> None:
    image = Spaces(
        observations={"observation": ArraySpace(shape=(64, 64, 3), dtype="uint8")},
        actions={"action": DiscreteSpace(counts=(2,))},
    )
    monkeypatch.setattr(learner_process, "expected_defaults", lambda *_: (image, default_settings(image)))
    monkeypatch.setattr(learner_process, "expected_spaces", lambda *_: image)
    monkeypatch.setattr(LearnerNetwork, "open", lambda *_: None)  # stopped while no router answered
    options = learner_options(parser().parse_args(["--env", "CartPole-v1"]), 0.0, Path())
    process = LearnerProcess(options, threading.Event(), UserMetrics())
    before = process._progress.updates_per_batch
    with ExitStack() as stack:
        process._serve(process._run, stack)
    assert (before, process._progress.updates_per_batch) == (10 * 16, 4 * 16)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (NetworkError("one_step_q, and continuous actions"), BAD_USAGE),
        (SettingsError("rollouts of one row, and masks"), BAD_USAGE),
        (DeviceError("no CUDA device"), FAILED),
        (RunInUseError("the run is in use"), FAILED),
        (TransportError("the address is in use"), FAILED),
    ],
)
def test_a_learner_that_fails_again_each_time_ends_with_the_status_of_bad_usage(
    monkeypatch: pytest.MonkeyPatch, error: Exception, status: int
) -> None:
    def fail(*_: object) -> int:
        raise error

    options = learner_options(parser().parse_args(["cartpole"]), 0.0, Path())
    process = LearnerProcess(options, threading.Event(), UserMetrics())
    monkeypatch.setattr(LogOptions, "configure", lambda *_, **_others: None)
    # Each fault would need a run, a network and an actor of its own; only what becomes of it is tested here.
    monkeypatch.setattr(process, "_serve", fail)
    assert process.run() == status
    process._actor_decides = True  # of which spaces the run is
    assert process.run() == FAILED


def test_settings_of_shared_actors_that_roles_have_different_are_named() -> None:
    one = spec_of("--env", "CartPole-v1")
    other = spec_of("--env", "CartPole-v1", "--set", "collection.envs_per_actor=3", "--seed", "2")
    assert not list(shared_settings({"prey": one, "hunter": one}))
    assert list(shared_settings({"prey": one, "hunter": other})) == [
        "collection.envs_per_actor differs between the roles (prey 8, hunter 3), which share actors: the largest one "
        "applies"
    ]
