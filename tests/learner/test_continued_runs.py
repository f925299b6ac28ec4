"""What a run continues with: settings that may change, annealing, its end, and initial weights."""

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from building import run_spec
from saved_runs import CARTPOLE, save

from daedalus.launch.resumed_run import ResumeChoice
from daedalus.learner.run.counters import Annealing, RunCounters
from daedalus.learner.run.resuming import (
    Beginning,
    CheckpointMismatchError,
    FinishedRun,
    allows_other_spaces,
    finished_run,
    other_network,
    other_spaces,
    with_changes,
)
from daedalus.learner.run.run_directory import create_locked, write_config, write_json
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.learner import Learner
from daedalus.policy.saving.saved_policy import FORMAT, SavedPolicy, find_policy
from daedalus.policy.saving.sealed import write_sealed
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EvaluationSpec, RunSpec

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


def test_settings_that_only_a_beginning_reads_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1)
    write_config(run, find_policy(run).spec)
    choice = ResumeChoice(directory=run, assignments=["training.mean_first_value=true", "training.passes=2"])
    choice.spec()
    shutil.rmtree(run / "checkpoints")
    choice.spec()
    start = "no effect in this run (algorithm impala): training."
    assert caplog.messages == [f"{start}mean_first_value, training.passes", f"{start}passes"]


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


def test_progress_is_the_used_share_of_the_budget_and_at_most_1() -> None:
    annealing = Annealing(budget=700)
    assert [annealing.at(env_steps) for env_steps in (0, 7, 123, 700, 800)] == [0.0, 7 / 700, 123 / 700, 1.0, 1.0]
    assert annealing.resumed(300, 700) is annealing
    assert annealing.resumed(300, 200).at(300) == 1.0
    used_up = annealing.resumed(705, 1400)
    assert [used_up.at(env_steps) for env_steps in (705, 1000, 1400)] == [1.0, 1.0, 1.0]
    resumed = annealing.resumed(300, 1100)
    assert Annealing(**json.loads(json.dumps(resumed.model_dump()))) == resumed


@pytest.mark.parametrize("budget", [1400, 400])
def test_other_budget_continues_from_the_progress_that_was_reached(budget: int) -> None:
    first = Annealing(budget=700)
    resumed = first.resumed(300, budget)
    assert resumed.at(300) == first.at(300) == 300 / 700
    middle = (300 + budget) // 2
    assert resumed.at(middle) == pytest.approx((300 / 700 + 1.0) / 2)
    assert resumed.at(budget) == 1.0
    again = resumed.resumed(middle, 10_000)
    assert again.at(middle) == resumed.at(middle)
    assert again.at(10_000) == 1.0


TARGET = {"target_return": 10.0, "target_episodes": 3}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run that was trained for 5000 env_steps, with a mean return of 12 over the newest episodes."""
    counters = RunCounters(3)
    counters.env_steps = 5000
    counters.returns.extend([11.0, 12.0, 13.0])
    write_sealed(tmp_path / "checkpoints" / "0000000007", {}, {"format": FORMAT, "counters": counters.state(60.0)})
    return tmp_path


def finished(run: Path, summary: dict[str, Any] | None, **training: Any) -> FinishedRun | None:
    if summary is not None:
        write_json(run / "summary.json", {"env_steps": 5000, "finished": True, "solved": True, **summary})
    return finished_run(run, run_spec(**training))


def test_a_run_at_its_budget_has_nothing_to_train(run: Path) -> None:
    end = finished(run, {"evaluation": {}}, env_steps=5000)
    assert end is not None
    assert end.reason == "5,000 env_steps are done, and the budget is 5,000: raise it with --env-steps"
    assert (end.missed, end.to_evaluate) == (False, False)
    assert finished(run, {}, env_steps=5001) is None
    smaller = finished(run, {"finished": False}, env_steps=20)  # it was stopped
    assert smaller is not None
    assert "the budget is 20:" in smaller.reason
    assert not smaller.to_evaluate


def test_a_run_without_final_episodes_has_nothing_to_evaluate(run: Path) -> None:
    write_json(run / "summary.json", {"env_steps": 5000, "finished": True, "solved": False})
    spec = run_spec(env_steps=5000)
    without = spec.model_copy(update={"evaluation": EvaluationSpec(final_episodes=0)})
    assert [end.to_evaluate for each in (without, spec) if (end := finished_run(run, each))] == [False, True]


def test_a_run_that_reached_its_target_has_nothing_to_train(run: Path) -> None:
    end = finished(run, {}, **TARGET)
    assert end is not None
    assert end.reason.startswith(
        "the target, mean return 10, was reached, and 5,000 env_steps are done: train on with --set"
    )
    assert (end.missed, end.to_evaluate) == (False, True)
    assert finished(run, {"finished": False, "solved": False}, **TARGET) is None  # before new episodes confirmed it
    assert finished(run, {}, **TARGET, stop_when_solved=False) is None
    assert finished(run, {}, **{**TARGET, "target_return": 99.0}) is None
    missed = finished(run, {}, **{**TARGET, "target_return": 99.0}, env_steps=5000)
    assert missed is not None
    assert missed.missed


def test_a_run_that_an_evaluation_solved_has_nothing_to_train(run: Path) -> None:
    counters = RunCounters(3)
    counters.env_steps = 5000
    counters.evaluated(99.0)
    write_sealed(run / "checkpoints" / "0000000008", {}, {"format": FORMAT, "counters": counters.state(60.0)})
    target = {**TARGET, "target_return": 99.0}
    for budget in (5000, 9000):
        end = finished(run, {}, **target, algorithm="one_step_q", env_steps=budget)
        assert end is not None
        assert end.reason.startswith("the target, mean return 99, was reached")
        assert not end.missed
    assert finished(run, {}, **target, env_steps=9000) is None  # actors that do not explore


def test_a_learner_that_was_killed_before_its_summary_is_started_again(run: Path) -> None:
    assert finished(run, None, env_steps=5000) is None
    assert finished(run, {"env_steps": 4000}, env_steps=5000) is None  # of an earlier end
    assert finished(run / "nowhere", None) is None


def test_a_damaged_checkpoint_is_skipped(run: Path) -> None:
    write_sealed(run / "checkpoints" / "0000000008", {}, {"format": FORMAT, "counters": {"env_steps": "many"}})
    (run / "checkpoints" / "0000000009").mkdir()
    assert finished(run, {}, env_steps=5000) is not None


PAIR = {name: ArraySpace(shape=(2,), dtype="float32") for name in ("angle", "speed")}
MOVE = {"action": ContinuousSpace(low=(-1.0, 0.0), high=(1.0, 1.0))}


def saved(observations: dict[str, Any] = PAIR, actions: dict[str, Any] = MOVE, **sections: Any) -> SavedPolicy:
    spec = RunSpec.model_validate({"environment": {"id": "Any-v0"}, **sections})
    spaces = Spaces(observations=observations, actions=actions)
    return SavedPolicy(directory=Path("run"), policy_version=1, spec=spec, spaces=spaces, program=b"", weights={})


def array(**changes: Any) -> dict[str, Any]:
    return {"angle": ArraySpace.model_validate({"shape": (4,), "dtype": "float32", **changes})}


@pytest.mark.parametrize(
    ("before", "now", "difference"),
    [
        (
            saved(),
            saved({"lidar": PAIR["angle"], "pose": PAIR["angle"]}),
            "observation angle, speed is not here; observation lidar, pose is not there",
        ),
        (
            saved(),
            saved(dict(reversed(PAIR.items()))),
            "the components of the observation are in the order angle, speed there, speed, angle here",
        ),
        (
            saved(array()),
            saved(array(dtype="uint8")),
            "observation angle is float32 array of shape (4,) there, and uint8 array of shape (4,) here",
        ),
        (saved(array()), saved(array(shape=(2, 2))), "observation angle is float32 array of shape (4,) there, and "),
        (saved(array()), saved(array(shape=(2,), frames=2)), "float32 array of shape (2,), 2 stacked here"),
        (
            saved({"x": DiscreteSpace(counts=(2, 4))}),
            saved({"x": DiscreteSpace(counts=(4, 2))}),
            "observation x is choices of 2 x 4 there, and choices of 4 x 2 here",
        ),
        (
            saved(),
            saved(actions={"action": ContinuousSpace(low=(-1.0, 0.0), high=(2.0, 1.0))}),
            "action action is 2 continuous (low -1 0, high 1 1) there, and 2 continuous (low -1 0, high 2 1) here",
        ),
        (
            saved(environment={"id": "Any-v0", "action_table": ((0.0,), (1.0,))}),
            saved(environment={"id": "Any-v0", "action_table": ((1.0,), (0.0,))}),
            "environment.action_table is another",
        ),
        (saved(), saved(environment={"id": "Other-v0", "kwargs": {"size": 8}}), ""),
    ],
)
def test_spaces_of_equal_shapes_differ_by_what_they_mean(
    before: SavedPolicy, now: SavedPolicy, difference: str
) -> None:
    found = other_spaces(before, now.spec.environment, now.spaces)
    assert difference in found
    assert bool(found) == bool(difference)


@pytest.mark.parametrize(
    ("before", "now", "difference"),
    [
        ({}, {"activation": "relu"}, "policy.activation is tanh there, and relu here: use the same [policy] settings"),
        ({}, {"distribution": "squashed_gaussian"}, "policy.distribution is gaussian there"),
        ({}, {"encoder": "mlp", "initial_std": 0.1}, ""),  # what `auto` is
        ({"encoder": "my_module:A"}, {"encoder": "my_module:B"}, "policy.encoder is my_module:A there"),
    ],
)
def test_network_of_equal_shapes_differs_by_what_it_computes(
    before: dict[str, Any], now: dict[str, Any], difference: str
) -> None:
    found = other_network(saved(policy=before), saved(policy=now).spec.policy, saved().spaces)
    assert found.startswith(difference)
    assert bool(found) == bool(difference)


@pytest.mark.parametrize(("before", "now"), [("sac", "n_step_q"), ("n_step_q", "sac")])
def test_probabilities_and_action_values_are_not_taken_for_each_other(tmp_path: Path, before: str, now: str) -> None:
    """With one discrete action their weights have the same names and shapes."""
    settings = {"distribution": "squashed_gaussian", "state_dependent_std": True}
    initial, other = (
        find_policy(save(tmp_path / name, CARTPOLE, 1, policy=settings, training={"algorithm": name}))
        for name in (before, now)
    )
    learner = Learner(other.spec.training, other.spec.policy, other.spaces)
    with pytest.raises(CheckpointMismatchError, match=rf"^--init-from .*: {before} learned .*, and {now} learns "):
        Beginning(initial=initial).load_into(learner, other.spec, 0.0)
    Beginning(initial=other).load_into(learner, other.spec, 0.0)


@pytest.mark.parametrize("allowed", [True, False])
def test_a_run_remembers_that_other_spaces_are_allowed(tmp_path: Path, allowed: bool) -> None:
    """Its learner reads it: after a crash before the first checkpoint, too."""
    create_locked(tmp_path, saved().spec, init_from=Path("first"), other_spaces=allowed).close()
    assert allows_other_spaces(tmp_path) is allowed
