"""learner/run/resuming.py: what differs between a saved policy and a run that begins with its weights."""

from pathlib import Path
from typing import Any

import pytest

from daedalus.learner.run.resuming import allows_other_spaces, other_network, other_spaces
from daedalus.learner.run.run_directory import create_locked
from daedalus.policy.saving.saved_policy import SavedPolicy
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec

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
            "observation angle, speed is not in this run; observation lidar, pose is not in that run",
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


@pytest.mark.parametrize("allowed", [True, False])
def test_a_run_remembers_that_other_spaces_are_allowed(tmp_path: Path, allowed: bool) -> None:
    """Its learner reads it: after a crash before the first checkpoint, too."""
    create_locked(tmp_path, saved().spec, init_from=Path("first"), other_spaces=allowed).close()
    assert allows_other_spaces(tmp_path) is allowed
