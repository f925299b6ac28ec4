import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from daedalus.protocol.algorithms import ALGORITHMS, ActorDemands
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import JOIN_LIMITS
from daedalus.protocol.messages import ActorStatus, Join, RunStatus
from daedalus.protocol.models import Specification
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import (
    ActorSpec,
    CollectionSpec,
    EnvironmentSpec,
    EvaluationSpec,
    PolicySpec,
    RunSpec,
    ServiceSpec,
    TrainingSpec,
    UnsupportedRunError,
)

ENVIRONMENT = {"id": "CartPole-v1"}
ARRAY = {"kind": "array", "shape": [4], "dtype": "float32"}
DISCRETE = {"kind": "discrete", "counts": [2]}
CONTINUOUS = {"kind": "continuous", "low": [-1.0, None], "high": [1.0, None]}
SPACES = {"observations": {"observation": ARRAY}, "actions": {"action": DISCRETE}}


def run(**sections: Any) -> RunSpec:
    return RunSpec.model_validate({"environment": ENVIRONMENT, **sections})


def test_environment_is_the_only_required_section() -> None:
    assert run().training == TrainingSpec()
    assert not run().algorithm.synchronous
    assert run(training={"algorithm": "a2c"}).algorithm.synchronous


@pytest.mark.parametrize(
    ("specification", "fields"),
    [
        (RunSpec, {"environment": ENVIRONMENT}),
        (EnvironmentSpec, ENVIRONMENT),
        (PolicySpec, {}),
        (CollectionSpec, {}),
        (TrainingSpec, {}),
        (EvaluationSpec, {}),
        (ServiceSpec, {}),
        (Spaces, SPACES),
        (ArraySpace, ARRAY),
        (DiscreteSpace, DISCRETE),
        (ContinuousSpace, CONTINUOUS),
    ],
)
def test_unknown_field_is_rejected_by_name(specification: type[Specification], fields: dict[str, Any]) -> None:
    specification.model_validate(fields)
    with pytest.raises(ValidationError, match=r"entropy_bonsu\n.*not permitted"):
        specification.model_validate({**fields, "entropy_bonsu": 1})


@pytest.mark.parametrize("section", ["environment", "policy", "collection", "training", "evaluation", "service"])
def test_unknown_fields_are_refused_within_sections(section: str) -> None:
    content = {"environment": dict(ENVIRONMENT), section: {**(ENVIRONMENT if section == "environment" else {})}}
    content[section]["typo"] = "1"
    with pytest.raises(ValidationError, match=rf"{section}\.typo\n.*not permitted"):
        RunSpec.model_validate(content)


@pytest.mark.parametrize("status", [ActorStatus, RunStatus])
def test_status_must_be_complete(status: type[Specification]) -> None:
    with pytest.raises(ValidationError, match="Field required"):
        status.model_validate({})


OUT_OF_RANGE: list[tuple[type[Specification], str, Any]] = [
    (ArraySpace, "shape", [0]),
    (ArraySpace, "shape", [-1]),
    (ArraySpace, "shape", [1.5]),
    (ArraySpace, "shape", []),
    (ArraySpace, "shape", [2] * 5),
    (ArraySpace, "dtype", "float64"),
    (ArraySpace, "frames", 0),
    (ArraySpace, "frames", 17),
    (DiscreteSpace, "counts", []),
    (DiscreteSpace, "counts", [0]),
    (DiscreteSpace, "counts", [65_537]),
    (DiscreteSpace, "counts", [2] * 4097),
    (ContinuousSpace, "low", []),
    (ContinuousSpace, "high", [math.inf]),
    (Spaces, "observations", {}),
    (Spaces, "actions", {}),
    (Spaces, "actions", {"": DISCRETE}),
    (Spaces, "actions", {"a b": DISCRETE}),
    (Spaces, "actions", {"a" * 65: DISCRETE}),
    (Spaces, "actions", {str(number): DISCRETE for number in range(65)}),
    (Spaces, "observations", {"observation": CONTINUOUS}),
    (EnvironmentSpec, "id", ""),
    (EnvironmentSpec, "id", "x" * 201),
    (EnvironmentSpec, "max_episode_steps", 0),
    (EnvironmentSpec, "backend", "dm_control"),
    (EnvironmentSpec, "action_table", [[0.0]]),
    (EnvironmentSpec, "action_table", [[0.0], [math.inf]]),
    (EnvironmentSpec, "action_repeat", 0),
    (EnvironmentSpec, "action_repeat", 65),
    (EnvironmentSpec, "no_reward_limit", 0),
    (EnvironmentSpec, "crop", [0, 0, 0]),
    (EnvironmentSpec, "crop", [0, 0, 0, -1]),
    (EnvironmentSpec, "resize", [0, 84]),
    (EnvironmentSpec, "resize", [84]),
    (EnvironmentSpec, "frame_stack", 0),
    (EnvironmentSpec, "frame_stack", 17),
    (EnvironmentSpec, "reward_clip", 0.0),
    (EnvironmentSpec, "reward_scale", 0.0),
    (EnvironmentSpec, "reward_scale", math.nan),
    (EnvironmentSpec, "kwargs", {"a": b"bytes"}),
    (PolicySpec, "encoder", "cnn"),
    (PolicySpec, "encoder", "module:"),
    (PolicySpec, "memory", "lstm"),
    (PolicySpec, "memory_units", 0),
    (PolicySpec, "memory_units", 4097),
    (PolicySpec, "hidden", [8] * 9),
    (PolicySpec, "hidden", [0]),
    (PolicySpec, "activation", "gelu"),
    (CollectionSpec, "actors", 0),
    (CollectionSpec, "envs_per_actor", 0),
    (CollectionSpec, "envs_per_actor", 4097),
    (CollectionSpec, "rollout_length", 0),
    (CollectionSpec, "rollout_length", 4097),
    (CollectionSpec, "window", 0),
    (CollectionSpec, "window", 65),
    (TrainingSpec, "algorithm", "ppo"),
    (TrainingSpec, "seed", -1),
    (TrainingSpec, "seed", 2**32),
    (TrainingSpec, "env_steps", 0),
    (TrainingSpec, "target_episodes", 0),
    (TrainingSpec, "batch_rollouts", 0),
    (TrainingSpec, "max_policy_lag", -1),
    (TrainingSpec, "discount_factor", 1.01),
    (TrainingSpec, "discount_factor", -0.01),
    (TrainingSpec, "discount_factor", math.nan),
    (TrainingSpec, "trace_lambda", 1.01),
    (TrainingSpec, "rho_clip", 0.0),
    (TrainingSpec, "trace_clip", 0.0),
    (TrainingSpec, "passes", 0),
    (TrainingSpec, "passes", 65),
    (TrainingSpec, "minibatches", 0),
    (TrainingSpec, "minibatches", 4097),
    (TrainingSpec, "clip_range", 0.0),
    (TrainingSpec, "device", "tpu"),
    (TrainingSpec, "precision", "float16"),
    (TrainingSpec, "value_loss", "mae"),
    (TrainingSpec, "value_coefficient", -0.1),
    (TrainingSpec, "entropy_bonus", -0.1),
    (TrainingSpec, "entropy_bonus_final", -0.1),
    (TrainingSpec, "optimizer", "sgd"),
    (TrainingSpec, "learning_rate", 0.0),
    (TrainingSpec, "learning_rate", 1.1),
    (TrainingSpec, "learning_rate", math.nan),
    (TrainingSpec, "learning_rate_final", -0.1),
    (TrainingSpec, "optimizer_epsilon", 0.0),
    (TrainingSpec, "rmsprop_decay", 1.1),
    (TrainingSpec, "max_gradient_norm", 0.0),
    (TrainingSpec, "threads", 0),
    (EvaluationSpec, "seconds", 0.0),
    (EvaluationSpec, "episodes", 0),
    (EvaluationSpec, "final_episodes", 0),
    (EvaluationSpec, "final_backend", "mujoco"),
    (ServiceSpec, "checkpoint_seconds", 0.0),
    (ServiceSpec, "keep_checkpoints", 0),
    (ServiceSpec, "log_seconds", 0.0),
    (ServiceSpec, "queue_megabytes", 0.0),
]


@pytest.mark.parametrize(("specification", "field", "value"), OUT_OF_RANGE)
def test_value_out_of_range_is_rejected_with_the_name_of_its_field(
    specification: type[Specification], field: str, value: Any
) -> None:
    all_required = {ArraySpace: ARRAY, EnvironmentSpec: ENVIRONMENT, Spaces: SPACES, ContinuousSpace: CONTINUOUS}
    required = all_required.get(specification, {})
    with pytest.raises(ValidationError) as refused:
        specification.model_validate({**required, field: value})
    assert {error["loc"][0] for error in refused.value.errors()} == {field}


def test_a2c_refuses_a_batch_size_of_its_own() -> None:
    with pytest.raises(ValidationError, match="batch_rollouts has no meaning for a2c"):
        run(training={"algorithm": "a2c", "batch_rollouts": 4})


def test_specification_is_immutable() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        run().training.seed = 2  # pyright: ignore[reportAttributeAccessIssue]


def test_specification_is_restored_from_its_json() -> None:
    spec = run(training={"target_return": 475.0}, policy={"hidden": [8, 16]})
    assert RunSpec.model_validate_json(spec.model_dump_json()) == spec


def test_spaces_have_a_readable_string() -> None:
    assert str(Spaces.model_validate(SPACES)) == "observation: float32 array of shape (4,); action: 2 choices"


def test_stack_adds_an_axis_unless_it_has_one_frame() -> None:
    one = ArraySpace(shape=(84, 96, 3), dtype="uint8")
    four = ArraySpace(shape=(84, 96, 3), dtype="uint8", frames=4)
    assert one.stacked_shape == (84, 96, 3)
    assert four.stacked_shape == (4, 84, 96, 3)
    assert str(one) == "uint8 array of shape (84, 96, 3)"
    assert str(four) == "uint8 array of shape (84, 96, 3), 4 stacked"


def test_stack_longer_than_a_rollout_is_rejected_with_a_remedy() -> None:
    run(environment={**ENVIRONMENT, "frame_stack": 4}, collection={"rollout_length": 4})
    with pytest.raises(ValidationError, match=r"frame_stack is 4.*rollout_length is 3, make it at least 4"):
        run(environment={**ENVIRONMENT, "frame_stack": 4}, collection={"rollout_length": 3})


@pytest.mark.parametrize(
    ("fields", "updates", "bound"),
    [
        ({"algorithm": "impala", "passes": 5}, 1, 32),
        ({"algorithm": "a3c"}, 1, 8),
        ({"algorithm": "appo", "passes": 3, "minibatches": 4}, 12, 384),
        ({"algorithm": "appo", "passes": 1, "minibatches": 1}, 1, 32),
        ({"algorithm": "appo", "passes": 3, "minibatches": 4, "max_policy_lag": 7}, 12, 7),
        ({"algorithm": "a3c", "max_policy_lag": 0}, 1, 0),
    ],
)
def test_default_lag_bound_counts_batches(fields: dict[str, Any], updates: int, bound: int) -> None:
    spec = RunSpec.model_validate({"environment": {"id": "e"}, "training": fields})
    assert (spec.training.updates_per_batch, spec.policy_lag_bound_with(0)) == (updates, bound)


@pytest.mark.parametrize(
    ("algorithm", "actors", "window", "bound"),
    [("a3c", 2, 2, 8), ("a3c", 5, 3, 30), ("impala", 5, 3, 32), ("impala", 5, 20, 40), ("appo", 1, 1, 32 * 9)],
)
def test_default_lag_bound_has_room_for_all_rollouts_in_flight(
    algorithm: str, actors: int, window: int, bound: int
) -> None:
    collection = {"actors": actors, "window": window}
    training = {"algorithm": algorithm, "passes": 3, "minibatches": 3}
    spec = RunSpec.model_validate({"environment": {"id": "e"}, "collection": collection, "training": training})
    assert spec.policy_lag_bound_with(0) == bound


def test_every_algorithm_has_its_mathematics() -> None:
    """A record without losses, or losses without a record, would fail only when a run names it."""
    from daedalus.algorithms.own_algorithm import CLASSES

    assert {name: algorithm.record for name, algorithm in CLASSES.items()} == ALGORITHMS


@pytest.mark.parametrize(("shape", "frames"), [((2**40,), 1), ((4096, 4096), 2), ((2**13, 2**13, 2**13, 2**13), 16)])
def test_observations_too_large_for_memory_are_refused(shape: tuple[int, ...], frames: int) -> None:
    """The first actor to join decides the spaces, and the learner allocates batches of them."""
    with pytest.raises(ValidationError, match="use at most 67,108,864"):
        ArraySpace(shape=shape, dtype="float32", frames=frames)
    ArraySpace(shape=(2048, 2048, 3), dtype="uint8", frames=4)


@pytest.mark.parametrize(
    ("space", "fields", "reason"),
    [
        (DiscreteSpace, {"counts": [40_000, 40_000]}, "80,000 choices together"),
        (ContinuousSpace, {"low": [0.0], "high": [1.0, 2.0]}, "1 lower bounds, but 2 upper bounds"),
        (ContinuousSpace, {"low": [1.0], "high": [0.0]}, "the lower bound 1 is above the upper bound 0"),
        (Spaces, {**SPACES, "observations": {str(n): {**ARRAY, "shape": [9 << 20]} for n in range(2)}}, "bytes: use"),
    ],
)
def test_inconsistent_space_is_rejected(space: type[Specification], fields: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        space.model_validate(fields)


def test_bounds_are_equal_if_they_are_in_float32() -> None:
    """An environment has them in float64 and a client's copy in float32: both are actors of one run."""
    ours, theirs = (
        ContinuousSpace(low=(-0.7,), high=(None,)),
        ContinuousSpace(low=(-float(np.float32(0.7)),), high=(None,)),
    )
    assert ours == theirs
    with pytest.raises(ValidationError, match="not finite in float32"):
        ContinuousSpace(low=(0.0,), high=(1e39,))


LONGEST = {"kind": "continuous", "low": [-1.23456789e-30] * 4096, "high": [1.23456789e30] * 4096}


@pytest.mark.parametrize(
    ("observations", "actions", "reason"),
    [
        ({"a": ARRAY}, {"a": {"kind": "discrete", "counts": [65_536]}, "b": CONTINUOUS}, "65,538 choices and numbers"),
        ({"a": {"kind": "discrete", "counts": [2]}}, {"a": LONGEST, "b": LONGEST}, "8,193 variables"),
        ({"a": {**ARRAY, "shape": [2**23]}, "b": {**ARRAY, "shape": [2**23 + 1]}}, {"a": DISCRETE}, "bytes"),
    ],
)
def test_components_have_limits_together(observations: dict, actions: dict, reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        Spaces.model_validate({"observations": observations, "actions": actions})


def test_join_with_the_largest_spaces_is_within_its_limits() -> None:
    many = {f"{'x' * 60}{number}": {**ARRAY, "shape": [16_000, 1, 1, 1]} for number in range(64)}
    spaces = Spaces.model_validate({"observations": many, "actions": {"a": LONGEST, "b": LONGEST}})
    join = Join(actor="a" * 64, incarnation=2**62, spaces=spaces, environments=4096)
    assert decode(encode(join), JOIN_LIMITS) == join


def test_spaces_of_several_components_have_a_readable_string() -> None:
    spaces = Spaces.model_validate(
        {
            "observations": {"camera": {**ARRAY, "shape": [8, 8], "dtype": "uint8", "frames": 2}, "goal": DISCRETE},
            "actions": {"arm": CONTINUOUS, "gripper": {**DISCRETE, "counts": [2, 3], "masked": True}},
        }
    )
    assert str(spaces) == (
        "observation: camera: uint8 array of shape (8, 8), 2 stacked, goal: 2 choices; "
        "action: arm: 2 continuous, gripper: choices of 2 x 3, masked"
    )
    assert spaces.masks == {"gripper": 5}


@pytest.mark.parametrize(
    ("shape", "dtype", "image"),
    [
        ((84, 84), "uint8", True),
        ((210, 160, 3), "uint8", True),
        ((3, 16, 16), "uint8", True),
        ((7, 7, 3), "uint8", False),
        ((128,), "uint8", False),
        ((84, 84), "float32", False),
        ((2, 84, 84, 3), "uint8", False),
        ((20, 5, 17), "uint8", False),
    ],
)
def test_images_are_told_from_other_arrays(shape: tuple[int, ...], dtype: str, image: bool) -> None:
    assert ArraySpace.model_validate({"shape": shape, "dtype": dtype}).is_image is image


def test_evaluations_play_the_true_task() -> None:
    trained = EnvironmentSpec(id="A-v0", no_reward_limit=5, training_kwargs={"easy": True}, action_repeat=2)
    assert trained.as_evaluated() == EnvironmentSpec(id="A-v0", action_repeat=2)
    assert not trained.trains_true_task
    assert not EnvironmentSpec(id="A-v0", no_reward_limit=5).trains_true_task
    same = {"kwargs": {"easy": True}, "training_kwargs": {"easy": True}}
    assert EnvironmentSpec.model_validate(
        {"id": "A-v0", "reward_scale": 0.1, "reward_clip": 1.0, **same}
    ).trains_true_task
    assert trained.as_evaluated("envpool") == EnvironmentSpec(id="A-v0", action_repeat=2, backend="envpool")


# ------------------------------------------------------------------------------------ what actors receive


def test_settings_that_only_the_learner_needs_do_not_travel() -> None:
    content = {"optimizer": "rmsprop", "learning_rate": 0.25, "env_steps": 77, "device": "cuda", "seed": 5}
    spec = run(training=content, evaluation={"final_episodes": 3}, service={"queue_megabytes": 2.0}).for_actors()
    assert spec == run(training={"seed": 5}, service={"queue_megabytes": 2.0}).for_actors()
    assert (spec.seed, spec.max_upload_bytes) == (5, 2 << 20)
    assert spec.changed == ("environment.id", "seed", "max_upload_bytes")


def test_demands_of_the_algorithm_reach_actors_that_do_not_know_it() -> None:
    own = {"algorithm": "mine:Own", "algorithm_record": {"synchronous": True, "corrected": True}}
    assert run(training=own).for_actors().algorithm == ActorDemands(synchronous=True)
    newer = run(training={"algorithm": "one_step_sarsa"}).for_actors()
    newer.learning["training"]["algorithm"] = "of_a_newer_release"  # type: ignore[index,call-overload]
    assert ActorSpec.model_validate(newer.model_dump(mode="json")).algorithm.next_action
    with pytest.raises(UnsupportedRunError, match=r"the run's training\.algorithm does not fit this release: "):
        _ = newer.learning_settings


def test_setting_of_a_newer_release_is_refused_where_it_is_used_and_the_actor_needs_it() -> None:
    spec = run(environment={"id": "A-v0", "grey": True}, policy={"hidden": (5,)}).for_actors()
    assert spec.changed == ("environment.id", "environment.grey", "learning.policy.hidden")
    spec.check_known()
    assert spec.learning_settings.policy.hidden == (5,)
    newer = spec.model_copy(update={"changed": (*spec.changed, "learning.training.newer")})
    newer.check_known()  # an actor without torch does not need it
    with pytest.raises(UnsupportedRunError, match=r"sets training\.newer, which this release does not know: upgrade"):
        _ = newer.learning_settings
    for path in ("newer", "environment.newer", "environment.grey.newer", "algorithm.newer"):
        newer = spec.model_copy(update={"changed": (*spec.changed, path)})
        with pytest.raises(UnsupportedRunError, match=f"sets {path}, which this release does not know: upgrade"):
            newer.check_known()
