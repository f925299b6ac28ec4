"""learner/run/resuming.py: which settings may change when a run is resumed."""

import shlex
from pathlib import Path

import pytest
from building import run_spec

from daedalus.learner.run.resuming import with_changes
from daedalus.learner.run.settings import SettingsError
from daedalus.protocol.spec import RunSpec

RUN = Path("runs/one")


@pytest.mark.parametrize(
    "assignment",
    [
        "training.env_steps=5_000_000",
        "training.learning_rate=0.5",
        "training.max_policy_lag=3",
        "collection.envs_per_actor=5",
        "evaluation.final_episodes=7",
        "service.keep_checkpoints=9",
        "environment.max_episode_steps=1000",
    ],
)
def test_settings_of_the_training_may_change(assignment: str) -> None:
    section, _, rest = assignment.partition(".")
    key, _, value = rest.partition("=")
    changed = with_changes(run_spec(), [assignment], RUN)
    assert getattr(getattr(changed, section), key) == float(value)
    before = run_spec().model_dump()
    before[section][key] = getattr(getattr(changed, section), key)
    assert changed == RunSpec.model_validate(before)


@pytest.mark.parametrize(
    "assignment",
    [
        "environment.id=Other-v0",
        "environment.reward_scale=2",
        "environment.kwargs.size=2",
        "policy.hidden=[3]",
        "training.algorithm=a3c",
        "training.optimizer=rmsprop",
        "training.seed=9",
    ],
)
def test_settings_that_define_what_is_learned_are_refused_by_name(assignment: str) -> None:
    name = assignment.partition("=")[0].replace(".size", "")
    with pytest.raises(SettingsError) as refused:
        with_changes(run_spec(), [assignment, "training.learning_rate=0.5"], RUN)
    assert str(refused.value) == (
        f"{name} cannot change when a run is resumed: start a new run from the weights of this one, such as with: "
        f"daedalus train runs/one/config.toml --init-from runs/one --set {shlex.quote(assignment)} "
        "--set training.learning_rate=0.5"
    )


def test_a_setting_may_be_repeated_and_a_wrong_one_is_reported() -> None:
    assert with_changes(run_spec(), ["training.seed=1", "environment.id=Any-v0"], RUN) == run_spec()
    with pytest.raises(SettingsError, match=r"unknown setting training.sed: did you mean training.seed"):
        with_changes(run_spec(), ["training.sed=1"], RUN)


def test_setting_that_cannot_change_is_named_although_others_do_not_go_with_it() -> None:
    before = run_spec(algorithm="impala", batch_rollouts=4)
    with pytest.raises(SettingsError, match=r"^training\.algorithm cannot change when a run is resumed"):
        with_changes(before, ["training.algorithm=a2c"], RUN)
    with pytest.raises(SettingsError, match=r"training\.learning_rate"):
        with_changes(before, ["training.learning_rate=7"], RUN)
