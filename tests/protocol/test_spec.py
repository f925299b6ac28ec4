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
    LeagueSpec,
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


SECTIONS = {
    "environment": (EnvironmentSpec, ENVIRONMENT),
    "policy": (PolicySpec, {}),
    "collection": (CollectionSpec, {}),
    "training": (TrainingSpec, {}),
    "evaluation": (EvaluationSpec, {}),
    "service": (ServiceSpec, {}),
    "league": (LeagueSpec, {}),
}


@pytest.mark.parametrize(
    ("specification", "fields"),
    [
        (RunSpec, {"environment": ENVIRONMENT}),
        *SECTIONS.values(),
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
    for section, (its_specification, its_fields) in SECTIONS.items():
        if its_specification is specification:
            with pytest.raises(ValidationError, match=rf"{section}\.typo\n.*not permitted"):
                run(**{section: {**its_fields, "typo": "1"}})


@pytest.mark.parametrize("status", [ActorStatus, RunStatus])
def test_status_must_be_complete(status: type[Specification]) -> None:
    with pytest.raises(ValidationError, match="Field required"):
        status.model_validate({})


OUT_OF_RANGE: dict[type[Specification], dict[str, list[Any]]] = {
    ArraySpace: {
        "shape": [[0], [-1], [1.5], [], [2] * 5],
        "dtype": ["float64"],
        "frames": [0, 17],
    },
    DiscreteSpace: {
        "counts": [[], [0], [65_537], [2] * 4097],
    },
    ContinuousSpace: {
        "low": [[]],
        "high": [[math.inf]],
    },
    Spaces: {
        "observations": [{}, {"observation": CONTINUOUS}],
        "actions": [
            {},
            {"": DISCRETE},
            {"a b": DISCRETE},
            {"a" * 65: DISCRETE},
            {str(number): DISCRETE for number in range(65)},
        ],
    },
    EnvironmentSpec: {
        "id": ["", "x" * 201],
        "max_episode_steps": [0],
        "backend": ["dm_control"],
        "action_table": [[[0.0]], [[0.0], [math.inf]]],
        "action_repeat": [0, 65],
        "no_reward_limit": [0],
        "crop": [[0, 0, 0], [0, 0, 0, -1]],
        "resize": [[0, 84], [84]],
        "frame_stack": [0, 17],
        "reward_clip": [0.0],
        "reward_scale": [0.0, math.nan],
        "kwargs": [{"a": b"bytes"}],
    },
    PolicySpec: {
        "encoder": ["cnn", "module:"],
        "memory": ["lstm"],
        "memory_units": [0, 4097],
        "hidden": [[8] * 9, [0]],
        "activation": ["gelu"],
    },
    CollectionSpec: {
        "actors": [0],
        "envs_per_actor": [0, 4097],
        "rollout_length": [0, 4097],
        "window": [0, 65],
    },
    TrainingSpec: {
        "algorithm": ["ppo"],
        "seed": [-1, 2**32],
        "env_steps": [0],
        "target_episodes": [0],
        "batch_rollouts": [0],
        "max_policy_lag": [-1],
        "discount_factor": [1.01, -0.01, math.nan],
        "trace_lambda": [1.01],
        "rho_clip": [0.0],
        "trace_clip": [0.0],
        "passes": [0, 65],
        "minibatches": [0, 4097],
        "clip_range": [0.0],
        "device": ["tpu"],
        "precision": ["float16"],
        "value_loss": ["mae"],
        "value_coefficient": [-0.1],
        "surrogate": ["ppo"],
        "entropy_bonus": [-0.1],
        "entropy_bonus_final": [-0.1],
        "curiosity": [-0.1, 101.0],
        "optimizer": ["sgd"],
        "learning_rate": [0.0, 1.1, math.nan],
        "learning_rate_final": [-0.1],
        "optimizer_epsilon": [0.0],
        "rmsprop_decay": [1.1],
        "max_gradient_norm": [0.0],
        "threads": [0],
    },
    EvaluationSpec: {
        "seconds": [0.0],
        "episodes": [0],
        "final_episodes": [-1],
        "final_backend": ["mujoco"],
    },
    ServiceSpec: {
        "checkpoint_seconds": [0.0],
        "keep_checkpoints": [0],
        "log_seconds": [0.0],
        "queue_megabytes": [0.0],
    },
    LeagueSpec: {
        "sides": [((),)],
        "past_share": [-0.1, 1.1, math.nan],
        "opponents": [{"random": 1.1}, {"": 0.1}],
        "choice": ["newest"],
        "keep_env_steps": [0],
        "versions": [0, 257],
        "rating_share": [0.6],
        "rating_actions": ["random"],
    },
}


@pytest.mark.parametrize(
    ("specification", "field"), [(each, field) for each, fields in OUT_OF_RANGE.items() for field in fields]
)
def test_value_out_of_range_is_rejected_with_the_name_of_its_field(
    specification: type[Specification], field: str
) -> None:
    all_required = {ArraySpace: ARRAY, EnvironmentSpec: ENVIRONMENT, Spaces: SPACES, ContinuousSpace: CONTINUOUS}
    for value in OUT_OF_RANGE[specification][field]:
        with pytest.raises(ValidationError) as refused:
            specification.model_validate({**all_required.get(specification, {}), field: value})
        assert {error["loc"][0] for error in refused.value.errors()} == {field}, value


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


def test_stack_adds_an_axis_unless_it_has_one_frame() -> None:
    assert ArraySpace(shape=(84, 96, 3), dtype="uint8").stacked_shape == (84, 96, 3)
    assert ArraySpace(shape=(84, 96, 3), dtype="uint8", frames=4).stacked_shape == (4, 84, 96, 3)


def test_stack_longer_than_a_rollout_is_rejected_with_a_remedy() -> None:
    run(environment={**ENVIRONMENT, "frame_stack": 4}, collection={"rollout_length": 4})
    with pytest.raises(ValidationError, match=r"frame_stack is 4.*rollout_length is 3, make it at least 4"):
        run(environment={**ENVIRONMENT, "frame_stack": 4}, collection={"rollout_length": 3})


@pytest.mark.parametrize(
    ("fields", "collection", "updates", "bound"),
    [
        ({"algorithm": "impala", "passes": 5}, {}, 1, 32),
        ({"algorithm": "a3c"}, {}, 1, 8),
        ({"algorithm": "appo", "passes": 3, "minibatches": 4}, {}, 12, 384),
        ({"algorithm": "appo", "passes": 1, "minibatches": 1}, {}, 1, 32),
        ({"algorithm": "appo", "passes": 3, "minibatches": 4, "max_policy_lag": 7}, {}, 12, 7),
        ({"algorithm": "a3c", "max_policy_lag": 0}, {}, 1, 0),
        # There is room for all rollouts in flight.
        ({"algorithm": "a3c"}, {"actors": 2, "window": 2}, 1, 8),
        ({"algorithm": "a3c"}, {"actors": 5, "window": 3}, 1, 30),
        ({"algorithm": "impala"}, {"actors": 5, "window": 3}, 1, 32),
        ({"algorithm": "impala"}, {"actors": 5, "window": 20}, 1, 40),
        ({"algorithm": "appo", "passes": 3, "minibatches": 3}, {"actors": 1, "window": 1}, 9, 32 * 9),
    ],
)
def test_default_lag_bound_counts_batches_and_rollouts_in_flight(
    fields: dict[str, Any], collection: dict[str, Any], updates: int, bound: int
) -> None:
    spec = run(training=fields, collection=collection)
    assert (spec.training.updates_per_batch, spec.policy_lag_bound_with(0)) == (updates, bound)


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
    older = spec.model_copy(update={"changed": (*spec.changed, "environment.patience")})
    with pytest.raises(UnsupportedRunError, match=r"patience, which environment\.no_reward_limit replaces .*: upgrade"):
        older.check_known()
    for path in ("newer", "environment.newer", "environment.grey.newer", "algorithm.newer"):
        newer = spec.model_copy(update={"changed": (*spec.changed, path)})
        with pytest.raises(UnsupportedRunError, match=f"sets {path}, which this release does not know: upgrade"):
            newer.check_known()
