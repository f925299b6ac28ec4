import math
from typing import Any

import pytest
from pydantic import ValidationError

from protocol.spec import (
    ActorStatus,
    ArraySpace,
    ChoiceSpace,
    CollectionSpec,
    EnvironmentSpec,
    PolicySpec,
    RunSpec,
    RunStatus,
    ServiceSpec,
    Spaces,
    Specification,
    TrainingSpec,
)

ENVIRONMENT = {"id": "CartPole-v1"}
SPACES = {"observation": {"shape": [4], "dtype": "float32"}, "action": {"count": 2}}


def run(**sections: Any) -> RunSpec:
    return RunSpec.model_validate({"environment": ENVIRONMENT, **sections})


def test_an_environment_alone_makes_a_run() -> None:
    assert run().training == TrainingSpec()
    assert not run().synchronous
    assert run(training={"algorithm": "a2c"}).synchronous


@pytest.mark.parametrize(
    ("specification", "fields"),
    [
        (RunSpec, {"environment": ENVIRONMENT}),
        (EnvironmentSpec, ENVIRONMENT),
        (PolicySpec, {}),
        (CollectionSpec, {}),
        (TrainingSpec, {}),
        (ServiceSpec, {}),
        (Spaces, SPACES),
        (ArraySpace, SPACES["observation"]),
        (ChoiceSpace, SPACES["action"]),
    ],
)
def test_a_field_that_is_not_known_is_refused_by_its_name(
    specification: type[Specification], fields: dict[str, Any]
) -> None:
    specification.model_validate(fields)
    with pytest.raises(ValidationError, match=r"entropy_bonsu\n.*not permitted"):
        specification.model_validate({**fields, "entropy_bonsu": 1})


@pytest.mark.parametrize("section", ["environment", "policy", "collection", "training", "service"])
def test_unknown_fields_are_refused_within_sections(section: str) -> None:
    content = {"environment": dict(ENVIRONMENT), section: {**(ENVIRONMENT if section == "environment" else {})}}
    content[section]["typo"] = "1"
    with pytest.raises(ValidationError, match=rf"{section}\.typo\n.*not permitted"):
        RunSpec.model_validate(content)


@pytest.mark.parametrize("status", [ActorStatus, RunStatus])
def test_a_status_must_be_complete(status: type[Specification]) -> None:
    with pytest.raises(ValidationError, match="Field required"):
        status.model_validate({})


OUT_OF_RANGE: list[tuple[type[Specification], str, Any]] = [
    (ArraySpace, "shape", [0]),
    (ArraySpace, "shape", [-1]),
    (ArraySpace, "shape", [1.5]),
    (ArraySpace, "dtype", "float64"),
    (ChoiceSpace, "count", 0),
    (ChoiceSpace, "count", 65_537),
    (EnvironmentSpec, "id", ""),
    (EnvironmentSpec, "id", "x" * 201),
    (EnvironmentSpec, "max_episode_steps", 0),
    (EnvironmentSpec, "reward_scale", 0.0),
    (EnvironmentSpec, "reward_scale", math.nan),
    (EnvironmentSpec, "kwargs", {"a": b"bytes"}),
    (PolicySpec, "encoder", "cnn"),
    (PolicySpec, "hidden", []),
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
    (ServiceSpec, "checkpoint_seconds", 0.0),
    (ServiceSpec, "keep_checkpoints", 0),
    (ServiceSpec, "log_seconds", 0.0),
    (ServiceSpec, "queue_megabytes", 0.0),
]


@pytest.mark.parametrize(("specification", "field", "value"), OUT_OF_RANGE)
def test_a_value_out_of_range_is_refused_by_its_fields_name(
    specification: type[Specification], field: str, value: Any
) -> None:
    required = {ArraySpace: {"shape": [4], "dtype": "uint8"}, EnvironmentSpec: ENVIRONMENT}.get(specification, {})
    with pytest.raises(ValidationError) as refused:
        specification.model_validate({**required, field: value})
    assert {error["loc"][0] for error in refused.value.errors()} == {field}


def test_a2c_refuses_a_batch_size_of_its_own() -> None:
    with pytest.raises(ValidationError, match="batch_rollouts has no meaning for a2c"):
        run(training={"algorithm": "a2c", "batch_rollouts": 4})


def test_a_specification_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        run().training.seed = 2  # pyright: ignore[reportAttributeAccessIssue]


def test_a_specification_survives_its_own_json() -> None:
    spec = run(training={"target_return": 475.0}, policy={"hidden": [8, 16]})
    assert RunSpec.model_validate_json(spec.model_dump_json()) == spec


def test_spaces_say_what_they_are() -> None:
    assert str(Spaces.model_validate(SPACES)) == "observation: float32 array of shape (4,); action: 2 choices"
