"""Gradients from actors: what the learner accepts, what it rejects, and that it counts each once."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from building import ENVIRONMENTS, EPOCH, ROWS, SPACES, identity, joined_fleet, make_rollout, run_spec

from daedalus.algorithms.rollout_gradients import RolloutGradients
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.rollout_judge import Rejected, RolloutJudge
from daedalus.learner.serving.upload_checks import first_component_violation, restored
from daedalus.learner.training.learner import Learner
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Message
from daedalus.protocol.spaces import LARGEST_OBSERVATION
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Gradient, Upload

VERSION, MAX_LAG = 10, 4


def spec_of(algorithm: str = "a3c") -> RunSpec:
    content = run_spec(algorithm=algorithm, max_policy_lag=MAX_LAG, normalize_rewards=True).model_dump()
    content["policy"]["normalize_observations"] = True
    content["collection"]["upload"] = "gradients"
    return RunSpec.model_validate(content)


SPEC = spec_of()
LEARNER = Learner(SPEC.training, SPEC.policy, SPACES)


def gradient(sequence: int = 0, version: int = VERSION, spec: RunSpec = SPEC, **replaced: Any) -> Gradient:
    actor = RolloutGradients(spec.learning, SPACES)
    actor.load(LEARNER.weights() | LEARNER.gradient_inputs(0.0))
    computed = actor.compute(make_rollout(identity(sequence=sequence), version=version, seed=sequence))
    return replace(computed, **replaced)


GOOD = gradient()


class Harness:
    def __init__(self) -> None:
        self.fleet = joined_fleet("a", "b")
        self.judge = RolloutJudge(SPEC, EPOCH, self.fleet)
        self.judge.gradient_shapes = LEARNER.gradient_shapes

    def receive(self, message: Message, sender: str = "a") -> Upload | Rejected:
        data = encode(message)
        refused = self.judge.refuse_size(sender, len(data))
        assert refused is None, refused
        return self.judge.decide(sender, self.judge.read(sender, data), VERSION, 1.0)


@pytest.fixture
def harness() -> Harness:
    return Harness()


@pytest.mark.parametrize("algorithm", ["a2c", "a3c"])
def test_a_gradient_is_accepted_once_and_in_float32(harness: Harness, algorithm: str) -> None:
    sent = gradient(version=VERSION - 1, spec=spec_of(algorithm))
    verdict = harness.receive(sent)
    assert isinstance(verdict, Gradient)
    assert {name: values.shape for name, values in verdict.gradient.items()} == LEARNER.gradient_shapes
    assert all(values.dtype == np.float32 for values in verdict.gradient.values())
    assert harness.fleet.actors["a"].policy_lag == 1
    again = harness.receive(sent)
    assert isinstance(again, Rejected)
    assert again.cause == "duplicate"


def test_its_episodes_and_env_steps_count_like_those_of_a_rollout() -> None:
    rollout = make_rollout(identity(), version=VERSION, seed=0)
    of_rollout, of_gradient = RunCounters(100), RunCounters(100)
    for counters, upload in ((of_rollout, rollout), (of_gradient, GOOD)):
        counters.accepted(upload, 10)
        counters.trained([upload], VERSION + 1, 1)
    assert of_gradient.state(0.0) == of_rollout.state(0.0)


def changed(part: str, name: str, value: Any) -> dict[str, Any]:
    return {part: getattr(GOOD, part) | {name: value}}


def with_bits(bits: int) -> dict[str, Any]:
    """Return a gradient with one value of these bits as a bfloat16."""
    planes = GOOD.gradient["value_head.bias"].copy()
    planes[:, 0] = bits >> 8, bits & 0xFF
    return changed("gradient", "value_head.bias", planes)


@pytest.mark.parametrize(
    ("replaced", "reason"),
    [
        (with_bits(0x7FC0), "the gradient has a value that is not finite"),
        (with_bits(0x7F80), "the gradient has a value that is not finite"),
        (with_bits(0x6E80), "the norm of the gradient is inf, at most 1e+12 is allowed"),
        (with_bits(0x5680), "the norm of the gradient is 7.04e+13, at most 1e+12 is allowed"),
        (changed("gradient", "value_head.bias", np.zeros(3, np.float32)), r"'value_head.bias' is [3], and in this"),
        (changed("gradient", "other", np.zeros(3, np.float32)), r"'other' is [3], and in this run's network absent"),
        ({"gradient": {"value_head.bias": np.zeros(1, np.float32)}}, "in this run's network ["),
        ({"env_steps": ROWS * ENVIRONMENTS + 1}, f"a rollout of this actor has {ROWS * ENVIRONMENTS} rows"),
        ({"moments": {}}, "moments are of none, expected observations/observation [2, 3], returns [2]"),
        (changed("moments", "returns", np.array([np.nan, 1.0])), "moments/returns has a value that is not finite"),
        (changed("moments", "returns", np.array([0.0, -1.0])), "moments/returns has a value that no rollout has"),
        (changed("moments", "returns", np.array([1e40, 1.0])), "moments/returns has a value that no rollout has"),
        ({"action_counts": {}}, "action_counts are of none, expected action"),
        (changed("action_counts", "action", np.full(4, 99)), "action_counts/action is not a count of 4 choices"),
        (changed("action_counts", "action", np.full(4, -1)), "action_counts/action is not a count of 4 choices"),
        (
            changed("action_counts", "action", np.full(4, GOOD.env_steps // 2)),
            f"action_counts/action is not a count of 4 choices in {GOOD.env_steps} env_steps",
        ),
        (changed("metrics", "entropy", np.array(np.nan, np.float32)), "metrics/entropy is nan"),
        (changed("metrics", "own", np.array(1.0, np.float32)), "metrics has the names"),
        ({"metrics": {}}, "metrics has the names none, expected policy_loss"),
        ({"episode_lengths": np.zeros_like(GOOD.episode_lengths)}, "episode_lengths has a value below 1"),
        ({"episode_returns": np.full_like(GOOD.episode_returns, np.inf)}, "episode_returns has a value that is not"),
        (
            {
                "env_steps": 0,
                "moments": {name: np.zeros_like(values) for name, values in GOOD.moments.items()},
                "action_counts": {"action": np.zeros(4, np.int64)},
            },
            "episodes ended in 0 env_steps",
        ),
    ],
)
def test_an_unfit_gradient_is_rejected_with_the_reason_and_three_quarantine_its_sender(
    harness: Harness, replaced: dict[str, Any], reason: str
) -> None:
    for number in range(3):
        verdict = harness.receive(replace(GOOD, **replaced))
        assert isinstance(verdict, Rejected)
        assert (verdict.cause, verdict.verdict) == ("unfit", "quarantined" if number == 2 else "rejected")
        assert reason in verdict.reason
        assert "\n" not in verdict.reason
    assert harness.fleet.actors["a"].rejected == {"unfit": 3}
    assert isinstance(harness.receive(replace(GOOD, identity=identity("b")), "b"), Gradient)


def test_the_largest_observations_that_rollouts_may_have_are_accepted() -> None:
    """The squared deviations of many rows add up."""
    frames = np.full((ROWS + 1, ENVIRONMENTS, 3), LARGEST_OBSERVATION, np.float32)
    frames[::2] *= -1.0
    rollout = make_rollout(version=VERSION, frames=frames)
    assert first_component_violation(rollout, SPACES, SPEC.policy) == ""
    actor = RolloutGradients(SPEC.learning, SPACES)
    actor.load(LEARNER.weights() | LEARNER.gradient_inputs(0.0))
    computed = replace(actor.compute(rollout), gradient=GOOD.gradient)
    assert float(computed.moments["observations/observation"].max()) > LARGEST_OBSERVATION**2
    harness = Harness()
    assert isinstance(harness.receive(computed), Gradient)
    moments = {"observations/observation": computed.moments["observations/observation"] * [[1.0], [10.0]]}
    too_large = replace(computed, identity=identity(sequence=1), moments={**computed.moments, **moments})
    verdict = harness.receive(too_large)
    assert isinstance(verdict, Rejected)
    assert "moments/observations/observation has a value that no rollout has" in verdict.reason


@pytest.mark.parametrize(
    ("message", "cause", "reason"),
    [
        (make_rollout(version=VERSION), "malformed", "the message is not a gradient, which this run takes"),
        (replace(GOOD, identity=identity(epoch=EPOCH + 1)), "epoch", "for another learner epoch"),
        (replace(GOOD, identity=identity(incarnation=2)), "unknown_actor", "incarnation 2"),
        (gradient(version=VERSION - MAX_LAG - 1), "stale", "policy lag 5, at most 4 is allowed"),
        (gradient(version=VERSION + 1), "unfit", "newer than the learner's version"),
    ],
)
def test_the_promises_about_rollouts_hold_for_gradients(
    harness: Harness, message: Message, cause: str, reason: str
) -> None:
    verdict = harness.receive(message)
    assert isinstance(verdict, Rejected)
    assert verdict.cause == cause
    assert reason in verdict.reason


def test_the_episodes_of_gradients_are_no_longer_than_the_rows_that_the_actor_has_sent(harness: Harness) -> None:
    verdict = harness.receive(replace(GOOD, episode_lengths=np.full_like(GOOD.episode_lengths, 500)))
    assert isinstance(verdict, Rejected)
    assert f"has played at most {ROWS} rows in each" in verdict.reason


def test_the_env_steps_of_gradients_are_bounded_by_time(harness: Harness) -> None:
    """305 messages of zeros once used up a budget of 20M env_steps within 3 s; the intake answers busy instead."""
    assert not harness.judge.is_too_fast(GOOD, 0.0)
    harness.fleet.actors["a"].rows = 1_000_000
    assert harness.judge.is_too_fast(GOOD, 3.0)
    assert not harness.judge.is_too_fast(GOOD, 3.1)
    assert not harness.judge.is_too_fast(replace(GOOD, identity=identity("b")), 3.0)


def test_a_run_of_rollouts_rejects_gradients() -> None:
    fleet = joined_fleet("a")
    judge = RolloutJudge(run_spec(), EPOCH, fleet)
    verdict = judge.read("a", encode(GOOD))
    assert isinstance(verdict, Rejected)
    assert verdict.cause == "malformed"


def test_the_size_of_a_gradient_is_bounded(harness: Harness) -> None:
    largest = max(len(encode(gradient(spec=spec_of(algorithm)))) for algorithm in ("a2c", "a3c"))
    assert harness.judge.refuse_size("a", largest) is None
    refused = harness.judge.refuse_size("a", 1 << 20)
    assert refused is not None
    assert refused.cause == "malformed"


# ------------------------------------------------------------------------------------ what one actor cannot decide


def of_actors(batch: int, **replaced: Any) -> list[Gradient]:
    """Return a gradient of each of a, b and z, of which the last has something replaced."""
    found = [replace(gradient(3 * batch + number), identity=identity(name)) for number, name in enumerate("abz")]
    return [restored(each) for each in [*found[:2], replace(found[2], **replaced)]]


def learner_after(*batches: list[Gradient]) -> Learner:
    learner = Learner(SPEC.training, SPEC.policy, SPACES)
    for batch in batches:
        learner.apply(batch, 0.0)
    return learner


@pytest.mark.parametrize(
    ("name", "replaced"),
    [
        ("returns", changed("moments", "returns", np.array([1e25, 1e3]))),
        ("observations/observation", changed("moments", "observations/observation", np.full((2, 3), 1e29))),
        ("gradient norm", {"gradient": {name: each * 0 + 1e10 for name, each in restored(GOOD).gradient.items()}}),
        ("metrics/value_loss", changed("metrics", "value_loss", np.array(1e30, np.float32))),
    ],
)
def test_a_gradient_far_outside_those_of_other_actors_is_left_out_and_named(name: str, replaced: Any) -> None:
    ordinary = [of_actors(batch) for batch in range(2)]
    bad = of_actors(2, **{part: {k: np.asarray(v) for k, v in content.items()} for part, content in replaced.items()})
    ours, theirs = learner_after(*ordinary, bad), learner_after(*ordinary, bad[:2])
    assert ours.far_outside == {bad[2]: name}
    for parameter, values in ours.weights().items():
        np.testing.assert_array_equal(values, theirs.weights()[parameter])
    assert abs(ours.metrics.take_means()["value_loss"]) < 1e3


def test_the_norm_of_one_actors_gradient_counts_little_if_nobody_confirms_it() -> None:
    """It has the opposite direction of the others, and 1,000 times their norm."""
    ordinary = [of_actors(batch) for batch in range(2)]
    mean = ordinary[0][0].gradient
    large = {name: -1000.0 * values for name, values in mean.items()}
    learner = learner_after(*ordinary)
    bad = of_actors(2, gradient=large)
    learner.apply(bad, 0.0)
    assert learner.far_outside == {}
    assert learner.metrics.take_means()["gradient_norm"] < 30 * bad[0].norm
