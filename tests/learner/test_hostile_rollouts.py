"""Rollouts of the right shapes with extreme content: the learner neither fails nor gets weights that are not finite."""

import json
from typing import Any

import numpy as np
from building import (
    ENVIRONMENTS,
    EPOCH,
    POLICY,
    RECURRENT,
    ROWS,
    SPACES,
    identity,
    joined_fleet,
    make_rollout,
    run_spec,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from plain import plain

from daedalus.learner.reporting.run_reporter import episode_statistics
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.rollout_judge import Rejected, RolloutJudge
from daedalus.learner.training.learner import Learner
from daedalus.protocol.codec import encode
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

CELLS = (ROWS, ENVIRONMENTS)
NORMALIZED = PolicySpec(hidden=(8,), activation="relu", normalize_observations=True)
POLICIES = (POLICY, RECURRENT, PolicySpec(hidden=(8,), activation="relu"), NORMALIZED)
# The bounds of the judge, numbers around them, and the ends of float32.
NUMBERS = [0.0, -0.0, 1e-45, 1.0, -1.0, 1e-4, 1e6, -1e6, 1e9, -1e9, 1e15, -1e15, 1e20, 3.4e38, -3.4e38]
SPECIAL = [np.nan, np.inf, -np.inf]
BOUNDS = {"frames": 1e15, "initial_state": 1.0, "behaviour_log_probs": 1e6, "rewards": 1e9, "episode_returns": np.inf}


@st.composite
def arrays(draw: st.DrawFn, name: str, honest: np.ndarray) -> np.ndarray:
    """Return an honest array, one extreme number everywhere, or some in an honest array; mostly within the bounds."""
    within = [number for number in NUMBERS if abs(number) <= BOUNDS[name]]
    if name == "behaviour_log_probs":
        within = [-abs(number) for number in within]
    number = st.sampled_from(within if draw(st.integers(0, 9)) else NUMBERS + SPECIAL)
    kind = draw(st.sampled_from(["honest", "one", "some"]))
    if kind == "one":
        return np.full_like(honest, draw(number))
    array = honest.copy()
    for _ in range(draw(st.integers(1, 4)) if array.size and kind == "some" else 0):
        array.flat[draw(st.integers(0, array.size - 1))] = draw(number)
    return array


@st.composite
def episodes(draw: st.DrawFn, honest: Rollout) -> dict[str, np.ndarray]:
    """Return ends, valid rows, returns and lengths: mostly of a right kind."""
    kind = draw(st.sampled_from(["honest", "none", "alternating", "random"]))
    if kind == "honest":
        terminated, truncated, valid = honest.terminated, honest.truncated, honest.valid
    elif kind == "random":
        bits = np.array(draw(st.lists(st.booleans(), min_size=3 * 18, max_size=3 * 18)), np.bool_)
        terminated, truncated, valid = bits.reshape(3, *CELLS)
    else:
        terminated = np.zeros(CELLS, np.bool_)
        terminated[::2] = kind == "alternating"
        truncated = terminated & draw(st.booleans())
        valid = np.ones(CELLS, np.bool_)
        valid[1:] = ~terminated[:-1]
        valid[0] = draw(st.booleans()) if kind == "none" else True
    count = max(int(np.count_nonzero(terminated | truncated)) + draw(st.sampled_from([0, 0, 0, 0, 0, 1])), 0)
    count = min(count, ROWS * ENVIRONMENTS)
    return {
        "terminated": terminated,
        "truncated": truncated,
        "valid": valid,
        "episode_returns": draw(arrays("episode_returns", np.ones(count, np.float32))),
        "episode_lengths": np.full(count, draw(st.sampled_from([1, 1, 2**31 - 1, 2**63 - 1, 0])), np.int64),
    }


@st.composite
def hostile(draw: st.DrawFn, sequence: int, state_size: int) -> Rollout:
    honest = make_rollout(seed=sequence, state_size=state_size)
    content: dict[str, Any] = {
        name: draw(arrays(name, getattr(honest, name))) for name in ("initial_state", "behaviour_log_probs", "rewards")
    }
    content["frames"] = draw(arrays("frames", plain(honest.frames)))
    actions = np.full(CELLS, draw(st.sampled_from([0, 3, 4, -1, 2**63 - 1])), np.int64)
    content["actions"] = draw(st.sampled_from([honest.actions, honest.actions, honest.actions, actions]))
    content |= draw(episodes(honest))
    if len(content["episode_returns"]):
        number = draw(st.sampled_from([None, 1.0, 3.4e38, -3.4e38]))
        content["episode_info"] = {} if number is None else {"x": np.full(1, number, np.float32)}
    return make_rollout(identity(sequence=sequence), state_size=state_size, **content)


@settings(max_examples=60)
@given(data=st.data())
def test_extreme_rollouts_do_not_break_the_learner(data: st.DataObject) -> None:
    algorithm = data.draw(st.sampled_from(["a2c", "a3c", "impala", "appo"]))
    policy = data.draw(st.sampled_from(POLICIES))
    optimizer = data.draw(st.sampled_from(["adam", "rmsprop"]))
    normalize = data.draw(st.booleans())
    training = {"algorithm": algorithm, "optimizer": optimizer, "normalize_advantages": normalize}
    training["normalize_rewards"] = data.draw(st.booleans())
    learner = Learner(TrainingSpec.model_validate({**training, "passes": 2, "minibatches": 2}), policy, SPACES)
    counters = RunCounters(10)
    for sequence in range(4):
        rollout = data.draw(hostile(sequence, learner.state_size))
        judge = RolloutJudge(run_spec(), EPOCH, joined_fleet("a"))  # without quarantine
        judge.state_size = learner.state_size
        verdict = judge.decide("a", judge.read("a", encode(rollout)), 0, 0.0)
        if isinstance(verdict, Rejected):
            assert verdict.cause == "unfit"
            continue
        batch = [make_rollout(identity("b"), seed=9, state_size=learner.state_size), verdict]
        counters.trained(batch, 0, 1)
        assert all(each is verdict for each in learner.step(batch, 0.0))
    assert all(np.isfinite(array).all() for array in learner.weights().values())
    assert all(bool(value.isfinite().all()) for value in learner.state().values())
    json.dumps(counters.state(0.0), allow_nan=False)
    assert all(np.isfinite(value) for value in episode_statistics(counters).values())
    assert all(np.isfinite(value) for value in learner.metrics.take_means().values())
