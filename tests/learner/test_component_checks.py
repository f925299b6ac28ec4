"""learner/serving/upload_checks.py: what a rollout of several components may contain."""

from typing import Any

import numpy as np
import pytest
from building import ENVIRONMENTS, EPOCH, ROWS, joined_fleet, make_rollout, run_spec

from daedalus.learner.serving.rollout_judge import Rejected, RolloutJudge
from daedalus.protocol.codec import encode
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces

SPACES = Spaces(
    observations={
        "numbers": ArraySpace(shape=(3,), dtype="float32", frames=2),
        "goal": DiscreteSpace(counts=(3, 300)),
        "map": ArraySpace(shape=(4, 4, 2), dtype="uint8"),
    },
    actions={
        "grip": DiscreteSpace(counts=(2, 3), masked=True),
        "arm": ContinuousSpace(low=(-1.0, None), high=(1.0, None)),
    },
)
CELLS = (ROWS, ENVIRONMENTS)


def content() -> dict[str, Any]:
    """Return the components of a valid rollout."""
    random = np.random.default_rng(0)
    masks = np.ones((*CELLS, 5), np.bool_)
    masks[2, 1] = [True, False, False, True, False]
    grip = random.integers(0, (2, 3), (*CELLS, 2)).astype(np.uint8)
    grip[2, 1] = 0, 1
    return {
        "frames": {
            "numbers": random.standard_normal((ROWS + 2, ENVIRONMENTS, 3), np.float32),
            "goal": random.integers(0, (3, 300), (ROWS + 1, ENVIRONMENTS, 2)).astype(np.uint16),
            "map": random.integers(0, (2, 5), (ROWS + 1, ENVIRONMENTS, 4, 4, 2)).astype(np.uint8),
        },
        "actions": {"grip": grip, "arm": random.standard_normal((*CELLS, 2), np.float32)},
        "masks": {"grip": masks},
    }


def verdict_on(changed: dict[str, Any]) -> str:
    """Return why a rollout is rejected, or an empty string."""
    spec = run_spec()
    spec = spec.model_copy(update={"policy": spec.policy.model_copy(update={"codes": {"map": (2, 5)}})})
    judge = RolloutJudge(spec, EPOCH, joined_fleet("a", spaces=SPACES))
    verdict = judge.decide("a", judge.read("a", encode(make_rollout(**changed))), 0, 0.0)
    return verdict.reason if isinstance(verdict, Rejected) else ""


def test_valid_rollout_is_accepted() -> None:
    assert verdict_on(content()) == ""


def test_components_may_come_in_any_order_and_integers_in_any_type() -> None:
    given = content()
    given["actions"] = {"arm": given["actions"]["arm"], "grip": given["actions"]["grip"].astype(np.int64)}
    assert verdict_on(given) == ""


def put(kind: str, name: str, place: tuple[int, ...], value: float) -> Any:
    """Return a change of one value."""

    def change(given: dict[str, Any]) -> None:
        given[kind][name][place] = value

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda given: given["frames"].pop("goal"), "frames has the components map, numbers, expected goal, map"),
        (lambda given: given["actions"].update(x=given["actions"]["arm"]), "actions has the components arm, grip, x"),
        (lambda given: given["masks"].clear(), "masks has the components none, expected grip"),
        (lambda given: given["masks"].update(grip=np.ones((*CELLS, 4), np.bool_)), "a mask of shape"),
        (put("frames", "goal", (1, 0, 0), 3), "frames/goal has a value outside choices of 3 x 300"),
        (put("frames", "map", (0, 1, 3, 2, 1), 5), "frames/map has the value 5 in place 1 of its last axis"),
        (put("frames", "numbers", (1, 0, 0), np.nan), "frames/numbers has a value that is not finite"),
        (put("frames", "numbers", (1, 0, 0), 2e15), "frames/numbers has a value beyond"),
        (
            lambda given: given["frames"].update(goal=given["frames"]["goal"].astype(np.float32)),
            "frames/goal is float32",
        ),
        (
            lambda given: given["frames"].update(numbers=given["frames"]["numbers"][1:]),
            f"frames/numbers is float32 ({ROWS + 1}, 3, 3), expected float32 ({ROWS + 2}, 3, 3)",
        ),
        (put("actions", "grip", (0, 0, 1), 3), "actions/grip has a value outside choices of 2 x 3"),
        (put("actions", "grip", (2, 1, 0), 1), "a choice that its mask forbids, in row 2 of environment 1"),
        (put("masks", "grip", (2, 1, 3), False), "a mask that forbids every choice in row 2 of environment 1"),
        (put("actions", "arm", (0, 0, 0), np.inf), "actions/arm has a value that is not finite"),
        (put("actions", "arm", (0, 0, 1), -2e6), "actions/arm has a value beyond +-1e+06"),
        (lambda given: given["actions"].update(arm=np.zeros((*CELLS, 3), np.float32)), "actions/arm is float32"),
        (lambda given: given["actions"].update(arm=np.zeros((*CELLS, 2), np.int64)), "actions/arm is int64"),
        (lambda given: given["actions"].update(grip=np.zeros((*CELLS, 2), np.float32)), "actions/grip is float32"),
    ],
)
def test_component_that_breaks_the_spaces_is_named(change: Any, reason: str) -> None:
    given = content()
    change(given)
    assert reason in verdict_on(given)


def test_long_names_are_cut_so_that_the_expected_ones_are_readable() -> None:
    given = content()
    given["frames"]["x" * 250_000] = given["frames"]["numbers"]
    reason = verdict_on(given)
    assert reason == f"frames has the components goal, map, numbers, {'x' * 64}, expected goal, map, numbers"


@pytest.mark.parametrize(("value", "accepted"), [(40.0, True), (40.1, False)])
def test_density_of_two_numbers_is_limited_to_twice_that_of_one(value: float, accepted: bool) -> None:
    log_probs = np.full(CELLS, value, np.float32)
    assert (verdict_on({**content(), "behaviour_log_probs": log_probs}) == "") == accepted
