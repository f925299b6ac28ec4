"""learner/run/counters.py: counters of a run, also after a resume."""

import json
from typing import Any

import numpy as np
import pytest
from building import make_rollout, run_spec

from daedalus.learner.run.counters import RunCounters
from daedalus.protocol.spec import TrainingSpec
from daedalus.protocol.uploads import Rollout


def rollout(version: int = 0, returns: tuple[float, ...] = (), seed: int = 0) -> Rollout:
    lengths = np.array([int(abs(value)) + 1 for value in returns], np.int32)
    episodes: dict[str, Any] = {"episode_returns": np.array(returns), "episode_lengths": lengths}
    return make_rollout(version=version, seed=seed, **episodes)


def test_only_valid_rows_are_counted_as_env_steps() -> None:
    counters, first, second = RunCounters(10), rollout(seed=1), rollout(seed=2)
    steps = int(first.valid.sum()) + int(second.valid.sum())
    assert steps < first.valid.size + second.valid.size
    for each in (first, second):
        counters.accepted(each, 500)
    assert (counters.env_steps, counters.accepted_env_steps) == (0, steps)
    counters.trained([first, second], 0, 12)
    assert counters.env_steps == steps
    assert (counters.rollouts_accepted, counters.rollouts_trained, counters.updates) == (2, 2, 12)
    assert counters.rollout_bytes == 1000


def test_policy_lag_is_the_learner_version_minus_the_rollout_version() -> None:
    counters = RunCounters(10)
    assert counters.policy_lag_mean == 0.0
    counters.trained([rollout(7), rollout(4)], 8, 1)
    counters.trained([rollout(9)], 9, 1)
    assert counters.policy_lag_mean == pytest.approx((1 + 4 + 0) / 3)
    assert counters.policy_lag_max == 4


def test_mean_return_is_over_the_newest_episodes() -> None:
    counters = RunCounters(3)
    assert counters.episode_return_mean is None
    counters.trained([rollout(returns=(1.0, 2.0)), rollout(returns=(3.0, 7.0))], 0, 1)
    assert counters.episode_return_mean == pytest.approx(4.0)
    assert counters.episodes == 4
    assert list(counters.lengths) == [3, 4, 8]


def test_target_is_reached_only_with_enough_episodes() -> None:
    counters = RunCounters(2)
    assert not counters.reached(0.0)
    counters.trained([rollout(returns=(9.0,))], 0, 1)
    assert not counters.reached(5.0)
    counters.trained([rollout(returns=(1.0,))], 0, 1)
    assert counters.reached(5.0)
    assert not counters.reached(5.1)
    assert not counters.reached(None)
    for target in (0.7, 0.9):  # a sum of equal numbers is rounded, and may be below
        counters = RunCounters(20)
        counters.trained([rollout(returns=(target,))] * 20, 0, 1)
        assert counters.reached(target)


def test_an_evaluation_solves_a_run_only_where_actors_explore() -> None:
    counters = RunCounters(2)
    target: dict[str, Any] = {"target_return": 5.0, "target_episodes": 2}
    exploring, others = run_spec(algorithm="one_step_q", **target), run_spec(**target)
    for mean, solved in ((4.9, False), (5.0, True), (2.0, True)):
        counters.evaluated(mean)
        assert (counters.is_solved(exploring), counters.is_solved(others)) == (solved, False)
    assert not counters.is_solved(run_spec(algorithm="one_step_q"))
    counters.trained([rollout(returns=(9.0, 9.0))], 0, 1)
    assert counters.is_solved(others)


def test_only_an_evaluation_solves_a_run_that_trains_on_another_task() -> None:
    counters = RunCounters(2)
    plain = run_spec(target_return=5.0, target_episodes=2)
    shaped = plain.model_copy(
        update={"environment": plain.environment.model_copy(update={"training_kwargs": {"bonus": 10}})}
    )
    counters.trained([rollout(returns=(9.0, 9.0))], 0, 1)
    assert (counters.is_solved(plain), counters.is_solved(shaped)) == (True, False)
    counters.evaluated(5.0)
    assert counters.is_solved(shaped)


def test_counters_of_an_earlier_release_are_restored() -> None:
    state = RunCounters(3).state(1.0)
    del state["best_evaluation"], state["accepted_env_steps"], state["seconds_to_target"]
    counters = RunCounters(3)
    counters.restore(state)
    assert (counters.best_evaluation, counters.accepted_env_steps, counters.seconds_to_target) == (None, 0, None)


@pytest.mark.parametrize(
    ("changed", "kept"),
    [
        ({}, True),
        ({"env_steps": 9}, True),
        ({"stop_when_solved": True}, False),
        ({"target_return": 6.0}, False),
        ({"target_episodes": 4}, False),
    ],
)
def test_target_has_to_be_reached_again_after_a_resume_where_it_is_another_or_ends_training(
    changed: dict[str, Any], kept: bool
) -> None:
    training = TrainingSpec(stop_when_solved=False, target_return=5.0, target_episodes=3)
    before = run_spec().model_copy(update={"training": training})
    after = before.model_copy(update={"training": training.model_copy(update=changed)})
    counters = RunCounters(3)
    counters.seconds_to_target = 1.5
    counters.forget_target(before, after)
    assert counters.seconds_to_target == (1.5 if kept else None)


def with_info(**values: tuple[float, ...]) -> Rollout:
    info = {name: np.array(each, np.float32) for name, each in values.items()}
    return make_rollout(
        episode_returns=np.zeros(5, np.float32), episode_lengths=np.ones(5, np.int32), episode_info=info
    )


def test_scalars_of_the_environment_are_kept_of_the_newest_episodes() -> None:
    counters = RunCounters(3)
    counters.trained([with_info(laps=(1.0, 2.0)), with_info(laps=(3.0, 4.0), crashed=(1.0,))], 0, 1)
    counters.trained([with_info(crashed=(0.0,))], 0, 1)
    assert {name: list(values) for name, values in counters.info.items()} == {
        "laps": [2.0, 3.0, 4.0],
        "crashed": [1.0, 0.0],
    }


def test_actors_with_many_names_do_not_grow_the_counters() -> None:
    counters = RunCounters(3)
    for number in range(5):
        counters.trained([with_info(**{f"name{number}.{each}": (1.0,) for each in range(8)})], 0, 1)
    assert len(counters.info) == 16
    assert "name1.7" in counters.info


def test_counters_restored_from_json_continue_equally() -> None:
    through, first = RunCounters(3), RunCounters(3)
    for number in range(3):
        through.trained([rollout(0, (0.1 * number, -2.5), number)], number, 2)
        through.accepted(rollout(seed=number), 100)
        through.rollouts_rejected["stale"] += 1
        through.snapshots_published += 1
        through.evaluated(0.1 * number)
    through.seconds_to_target = 7.5
    state = json.loads(json.dumps(through.state(12.5)))
    assert state.keys() == set(RunCounters.__slots__) - {
        "target_episodes",
        "info",
        "learning_seconds",
        "decoding_seconds",
    }
    first.restore(state)
    assert first.wall_seconds == 12.5
    through.wall_seconds = 12.5
    assert first == through
    for counters in (through, first):
        counters.trained([rollout(3, (5.0,))], 4, 3)
        counters.rollouts_rejected["duplicate"] += 1
    assert first == through
