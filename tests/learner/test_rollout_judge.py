"""learner/serving/rollout_judge.py: every cause of rejection, and acceptance at most once."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from building import ENVIRONMENTS, EPOCH, ROWS, SPACES, identity, joined_fleet, make_rollout, run_spec
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from plain import ACTION, NAME, choices, plain, plain_spaces, vector_spaces

from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.rollout_judge import Rejected, RolloutJudge, acknowledgement
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Join, RunEnded, Snapshot
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout, Upload

VERSION, MAX_LAG = 10, 4
FENCED = ("epoch", "unknown_actor")  # the causes for which an actor joins again


class Harness:
    """RolloutJudge with a fleet of actors `a` and `b`, at one policy version."""

    def __init__(self, **training: Any) -> None:
        self.fleet = joined_fleet("a", "b")
        self.judge = RolloutJudge(run_spec(max_policy_lag=MAX_LAG, **training), EPOCH, self.fleet)

    def receive(self, data: bytes, sender: str = "a", now: float = 1.0) -> Upload | Rejected:
        return self.judge.decide(sender, self.judge.read(sender, data), VERSION, now)

    def memory(self) -> list[Any]:
        """Return the state of the fleet, without the fields that a rejection may change."""
        actors = [dataclasses.asdict(actor) for actor in self.fleet.actors.values()]
        return [
            self.fleet.spaces,
            [{**each, "last_seen": None, "rejected": None, "consecutive_unfit": None} for each in actors],
        ]


@pytest.fixture
def harness() -> Harness:
    return Harness()


def good(**replaced: Any) -> Rollout:
    return make_rollout(**{"version": VERSION, **replaced})


def assert_rejected(harness: Harness, data: bytes, cause: str, reason: str = "", sender: str = "a") -> Rejected:
    """Assert that a message is rejected and counted under `cause`, and that a valid rollout is accepted afterwards."""
    before = harness.memory()
    verdict = harness.receive(data, sender)
    assert isinstance(verdict, Rejected)
    assert (verdict.verdict, verdict.cause) == ("fenced" if cause in FENCED else "rejected", cause)
    assert reason in verdict.reason
    assert harness.memory() == before
    if sender in harness.fleet.actors:
        assert harness.fleet.actors[sender].rejected == {cause: 1}
    assert isinstance(harness.receive(encode(good(rollout_identity=identity(sequence=1000)))), Rollout)
    return verdict


def with_value(name: str, value: float) -> Rollout:
    """Return a valid rollout with one value of one array replaced."""
    value_of = getattr(good(), name)
    array = (plain(value_of) if isinstance(value_of, dict) else value_of).copy()
    array.flat[-1] = value
    return good(**{name: array})


# ------------------------------------------------------------------------------------------- acceptance


def test_valid_rollout_is_accepted_unchanged(harness: Harness) -> None:
    rollout = good(version=VERSION - 2)
    verdict = harness.receive(encode(rollout), now=5.0)
    assert isinstance(verdict, Rollout)
    assert verdict.identity == rollout.identity
    np.testing.assert_array_equal(plain(verdict.frames), plain(rollout.frames))
    actor = harness.fleet.actors["a"]
    assert (actor.accepted, actor.policy_lag, actor.last_seen) == (1, 2, 5.0)
    assert not actor.rejected
    assert acknowledgement(verdict, VERSION).verdict == "accepted"
    assert acknowledgement(verdict, VERSION).policy_version == VERSION


def test_same_sequence_number_from_two_actors_is_accepted_from_both(harness: Harness) -> None:
    for actor in ("a", "b"):
        assert isinstance(harness.receive(encode(good(rollout_identity=identity(actor))), actor), Rollout)


def test_rollout_with_policy_lag_at_the_bound_is_accepted(harness: Harness) -> None:
    assert isinstance(harness.receive(encode(good(version=VERSION - MAX_LAG))), Rollout)


def test_acknowledgement_cuts_a_long_reason_to_500_characters(harness: Harness) -> None:
    verdict = Rejected(verdict="fenced", cause="epoch", reason="x" * 9000)
    answer = acknowledgement(verdict, VERSION)
    assert (answer.verdict, answer.reason, answer.policy_version) == ("fenced", "x" * 500, VERSION)


# -------------------------------------------------------------------------------------------- malformed


@pytest.mark.parametrize(
    "data",
    [b"", b"DAED", b"nonsense of some length, no message", encode(good())[:-1], encode(good()) + b"\0"],
    ids=["empty", "too short", "nonsense", "cut", "too long"],
)
def test_bytes_that_are_no_message_are_rejected_as_malformed(harness: Harness, data: bytes) -> None:
    assert_rejected(harness, data, "malformed")


def test_message_with_many_arrays_is_rejected_as_malformed(harness: Harness) -> None:
    weights = {str(number): np.zeros(1, np.float32) for number in range(37)}
    data = encode(Snapshot(learner_epoch=EPOCH, policy_version=0, program="", weights=weights))
    assert_rejected(harness, data, "malformed", "37 arrays, the limit is 36")


def test_each_component_adds_its_arrays_to_the_limit() -> None:
    """A component of the observation has one array, a component of the action two, with its masks."""
    observation, action = ArraySpace(shape=(3,), dtype="float32"), DiscreteSpace(counts=(4,))
    spaces = Spaces(observations={"a": observation, "b": observation}, actions=dict.fromkeys("cde", action))
    weights = {str(number): np.zeros(1, np.float32) for number in range(42)}
    data = encode(Snapshot(learner_epoch=EPOCH, policy_version=0, program="", weights=weights))
    verdict = stacked_harness(spaces).receive(data)
    assert isinstance(verdict, Rejected)
    assert verdict.reason == "42 arrays, the limit is 41"


def test_message_of_another_type_is_rejected_as_malformed(harness: Harness) -> None:
    data = encode(RunEnded(learner_epoch=EPOCH, outcome="finished", reason=""))
    assert assert_rejected(harness, data, "malformed").reason == "the message is not a rollout"


@pytest.mark.parametrize(
    "rollout",
    [
        good(rows=ROWS - 1),
        good(rows=ROWS + 1),
        good(environments=ENVIRONMENTS - 1),
        good(environments=ENVIRONMENTS + 1),
        good(rows=ROWS - 1, stack=2),  # the expected number of frames
    ],
    ids=["T too small", "T too large", "E too small", "E too large", "a stack for a row"],
)
def test_rollout_with_wrong_number_of_rows_or_environments_is_rejected_as_unfit(
    harness: Harness, rollout: Rollout
) -> None:
    reason = f"the rollout has {rollout.rows} rows of {rollout.environments} environments, expected {ROWS} rows of"
    assert_rejected(harness, encode(rollout), "unfit", reason)


@pytest.mark.parametrize(
    "rollout",
    [
        good(shape=(4,)),
        good(shape=(2,)),
        good(shape=(3, 1)),
        good(stack=2),
        good(frames=np.zeros((ROWS + 1, ENVIRONMENTS, 3), np.uint8)),
    ],
    ids=["larger", "smaller", "more dimensions", "a stack", "dtype"],
)
def test_frames_with_wrong_shape_or_dtype_are_rejected_with_both_shapes_named(
    harness: Harness, rollout: Rollout
) -> None:
    theirs = f"frames/observation is {plain(rollout.frames).dtype} {plain(rollout.frames).shape}"
    verdict = assert_rejected(harness, encode(rollout), "unfit", theirs)
    assert f"expected float32 {(ROWS + 1, ENVIRONMENTS, 3)}" in verdict.reason


def test_oversized_rollout_is_rejected_before_it_is_unpacked(harness: Harness) -> None:
    bomb = good(rows=4000, environments=500, frames=np.zeros((4001, 500, 3), np.float32))
    assert_rejected(harness, encode(bomb), "malformed", "the limit is")


@pytest.mark.parametrize("action", [-1, choices(SPACES), 2**31 - 1])
def test_action_out_of_range_is_rejected_as_unfit(harness: Harness, action: int) -> None:
    actions = plain(good().actions)[..., 0].astype(np.int32)
    actions[-1, -1] = action
    assert_rejected(harness, encode(good(actions=actions)), "unfit", "action")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["frames", "behaviour_log_probs", "rewards", "episode_returns"])
def test_value_that_is_not_finite_is_rejected_with_its_array_named(harness: Harness, name: str, value: float) -> None:
    assert_rejected(harness, encode(with_value(name, value)), "unfit", name)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_episode_info_that_is_not_finite_is_rejected(harness: Harness, value: float) -> None:
    info = {"distance": np.full(1, value, np.float32)}
    assert_rejected(harness, encode(good(episode_info=info)), "unfit", "episode_info 'distance'")


def test_all_the_episode_info_that_a_rollout_may_have_is_accepted(harness: Harness) -> None:
    most = len(good().episode_returns)
    info = {f"{number:064}": np.full(most, 1.0, np.float32) for number in range(16)}
    accepted = harness.receive(encode(good(episode_info=info)))
    assert isinstance(accepted, Rollout)
    assert accepted.episode_info.keys() == info.keys()


def test_log_probability_above_0_is_rejected_as_unfit(harness: Harness) -> None:
    assert_rejected(harness, encode(with_value("behaviour_log_probs", 0.01)), "unfit", "behaviour_log_probs")


def test_log_probability_above_0_by_rounding_is_accepted(harness: Harness) -> None:
    assert isinstance(harness.receive(encode(with_value("behaviour_log_probs", 0.99e-4))), Rollout)
    assert isinstance(Harness().receive(encode(with_value("behaviour_log_probs", 1.01e-4))), Rejected)


def test_rollout_with_a_future_policy_version_is_rejected_as_unfit(harness: Harness) -> None:
    assert_rejected(harness, encode(good(version=VERSION + 1)), "unfit", "is newer than the learner's version")


@pytest.mark.parametrize("size", [1, 7])
def test_recurrent_state_is_rejected_when_the_policy_has_no_memory(harness: Harness, size: int) -> None:
    reason = f"initial_state has size {size}, expected 0"
    assert_rejected(harness, encode(good(state_size=size)), "unfit", reason)


@pytest.mark.parametrize("size", [0, 4, 6])
def test_recurrent_state_of_wrong_size_is_rejected(harness: Harness, size: int) -> None:
    harness.judge.state_size = 5
    verdict = harness.receive(encode(good(state_size=size)))
    assert isinstance(verdict, Rejected)
    assert verdict.reason == f"initial_state has size {size}, expected 5"
    assert isinstance(harness.receive(encode(good(state_size=5))), Rollout)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_recurrent_state_that_is_not_finite_is_rejected(harness: Harness, value: float) -> None:
    harness.judge.state_size = 5
    state = np.zeros((ENVIRONMENTS, 5), np.float32)
    state[-1, -1] = value
    verdict = harness.receive(encode(good(initial_state=state)))
    assert isinstance(verdict, Rejected)
    assert verdict.reason == "initial_state has a value that is not finite"


# ----------------------------------------------------------------------------------------------- stacks

STACKED = ArraySpace(shape=(60, 80, 3), dtype="uint8", frames=4)
PICTURES = plain_spaces(STACKED, 4)


def stacked_harness(spaces: Spaces = PICTURES, state_size: int = 0) -> Harness:
    harness = Harness()
    harness.fleet = joined_fleet("a", spaces=spaces)
    harness.judge = RolloutJudge(run_spec(max_policy_lag=MAX_LAG), EPOCH, harness.fleet)
    harness.judge.state_size = state_size
    return harness


def pixels(length: int = ROWS + 4, shape: tuple[int, ...] = STACKED.shape) -> np.ndarray:
    """Return noise, which is not compressible."""
    return np.random.default_rng(0).integers(0, 256, (length, ENVIRONMENTS, *shape), np.uint8)


def test_stacked_observations_are_sent_as_single_frames() -> None:
    rollout = good(frames=pixels())
    verdict = stacked_harness().receive(encode(rollout))
    assert isinstance(verdict, Rollout)
    np.testing.assert_array_equal(plain(verdict.frames), plain(rollout.frames))


def test_frames_with_environment_first_memory_layout_are_decoded_equally() -> None:
    swapped = np.ascontiguousarray(pixels().swapaxes(0, 1)).swapaxes(0, 1)
    verdict = stacked_harness().receive(encode(good(frames=swapped)))
    assert isinstance(verdict, Rollout)
    np.testing.assert_array_equal(plain(verdict.frames), pixels())


@pytest.mark.parametrize(
    "frames",
    [
        pixels(ROWS + 1),
        pixels(ROWS + 3),
        pixels(ROWS + 5),
        pixels(shape=(80, 60, 3)),
        pixels(shape=(60, 80)),
        pixels(shape=(4, 60, 80, 3))[: ROWS + 1],
        pixels(shape=(59, 80, 3)),
    ],
    ids=["no stack", "a smaller stack", "a larger stack", "turned", "grey", "stacked already", "a line less"],
)
def test_frames_with_wrong_stack_or_size_are_rejected(frames: np.ndarray) -> None:
    verdict = stacked_harness().receive(encode(good(frames=frames)))
    assert isinstance(verdict, Rejected)
    assert ("the limit is" if verdict.cause == "malformed" else "frames/observation is uint8") in verdict.reason


def test_size_limit_accepts_the_largest_valid_rollout_and_rejects_twice_its_frames() -> None:
    largest = good(frames=pixels(), initial_state=np.zeros((ENVIRONMENTS, 40_000), np.float32))
    every_second = np.broadcast_to((np.arange(ROWS) % 2 == 0)[:, None], (ROWS, ENVIRONMENTS)).copy()
    most = int(every_second.sum())  # episodes of one row, each followed by a reset row
    largest = dataclasses.replace(
        largest,
        actions={ACTION: plain(largest.actions).astype(np.int64)},
        terminated=every_second,
        truncated=np.zeros_like(every_second),
        valid=every_second,
        episode_returns=np.zeros(most, np.float32),
        episode_lengths=np.ones(most, np.int64),
    )
    assert isinstance(stacked_harness(state_size=40_000).receive(encode(largest)), Rollout)
    too_many = good(frames=pixels(2 * (ROWS + 4)))
    verdict = stacked_harness().receive(encode(too_many))
    assert isinstance(verdict, Rejected)
    assert "the limit is" in verdict.reason


def test_rollout_of_exactly_64_mib_is_not_refused() -> None:
    """4,096 x (6 x 32 + (6 + 2) x 2,022) bytes, and 64 KiB."""
    spaces = plain_spaces(ArraySpace(shape=(2022,), dtype="uint8", frames=2), 4)
    judge = RolloutJudge(run_spec(), EPOCH, joined_fleet("a", environments=4096, spaces=spaces))
    verdict = judge.read("a", b"no message")
    assert isinstance(verdict, Rejected)
    assert verdict.cause == "malformed"


def test_message_as_large_as_the_queue_is_not_refused() -> None:
    spec = run_spec()
    small = spec.service.model_copy(update={"queue_megabytes": 0.125})
    judge = RolloutJudge(spec.model_copy(update={"service": small}), EPOCH, joined_fleet("a", environments=1000))
    assert judge.refuse_size("a", 1 << 17) is None
    refused = judge.refuse_size("a", (1 << 17) + 1)
    assert refused is not None
    assert (refused.verdict, refused.cause) == ("rejected", "unfit")
    assert "service.queue_megabytes allows 131,072" in refused.reason


@pytest.mark.parametrize("spaces", [SPACES, None])
def test_large_message_of_a_sender_that_has_not_joined_is_fenced(spaces: Spaces | None) -> None:
    """Up to 64 KiB may be a rollout of anybody: reading it tells more."""
    judge = RolloutJudge(run_spec(), EPOCH, Fleet(seed=1, spaces=spaces))
    assert judge.refuse_size("b", 64 << 10) is None
    assert judge.refuse_size("b", (64 << 10) + 1) == Rejected(
        verdict="fenced", cause="unknown_actor", reason="actor 'b' has not joined"
    )


@pytest.mark.parametrize(
    ("action", "action_bytes"),
    [
        (DiscreteSpace(counts=(4, 2)), 2 * 8),
        (DiscreteSpace(counts=(4, 2), masked=True), 2 * 8 + 6),
        (ContinuousSpace(low=(0.0,) * 3, high=(1.0,) * 3), 3 * 4),
    ],
)
def test_size_limit_is_the_documented_one(action: DiscreteSpace | ContinuousSpace, action_bytes: int) -> None:
    """E (T (24 + action bytes) + (T + k) frame bytes + 4 S) + 64 KiB, and the header: docs/wire.md."""
    harness = stacked_harness(Spaces(observations={NAME: STACKED}, actions={ACTION: action}), state_size=7)
    limit = ENVIRONMENTS * (ROWS * (24 + action_bytes) + (ROWS + 4) * 60 * 80 * 3 + 4 * 7) + (64 << 10)
    message = Limits(max_bytes=limit).message_bytes
    assert harness.judge.refuse_size("a", message) is None
    refused = harness.judge.refuse_size("a", message + 1)
    assert refused is not None
    assert (refused.verdict, refused.cause) == ("rejected", "malformed")
    assert refused.reason == f"the message has {message + 1:,} bytes, and a rollout of this actor at most {message:,}"


@pytest.mark.parametrize(
    ("shape", "environments", "refused"),
    [
        ((60, 80, 3), 464, False),
        ((60, 80, 3), 465, True),  # more than 64 MiB
        ((1000, 1000, 3), 8 * ENVIRONMENTS, False),  # the run's own rollouts have 90 MB
        ((1000, 1000, 3), 8 * ENVIRONMENTS + 2, True),
    ],
)
def test_rollouts_of_too_many_environments_are_refused_before_they_are_decoded(
    shape: tuple[int, ...], environments: int, refused: bool
) -> None:
    """4,096 environments of zeros compress to nothing, and would take gigabytes."""
    spaces = plain_spaces(STACKED.model_copy(update={"shape": shape}), 4)
    judge = RolloutJudge(run_spec(), EPOCH, joined_fleet("a", environments=environments, spaces=spaces))
    verdict = judge.read("a", b"no message")
    assert isinstance(verdict, Rejected)
    assert (verdict.verdict, verdict.cause) == ("rejected", "unfit" if refused else "malformed")
    assert ("use fewer environments per actor (collection.envs_per_actor" in verdict.reason) == refused


@given(st.data())
def test_corrupted_bytes_always_get_a_verdict(data: st.DataObject) -> None:
    message = bytearray(encode(good()))
    for place in data.draw(st.lists(st.integers(0, len(message) - 1), min_size=1, max_size=4)):
        message[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.sampled_from([None, None, data.draw(st.integers(0, len(message)))]))
    assert isinstance(Harness().receive(bytes(message[:cut])), Rollout | Rejected)


# ------------------------------------------------------------------------------- identity and policy version


def test_rollout_for_another_learner_epoch_is_fenced(harness: Harness) -> None:
    verdict = assert_rejected(harness, encode(good(rollout_identity=identity(epoch=EPOCH - 1))), "epoch")
    assert verdict.reason == "the rollout is for another learner epoch"
    assert acknowledgement(verdict, VERSION).verdict == "fenced"


def test_rollout_of_an_actor_that_never_joined_is_fenced(harness: Harness) -> None:
    verdict = assert_rejected(harness, encode(good(rollout_identity=identity("z"))), "unknown_actor", sender="z")
    assert verdict.reason == "actor 'z' has not joined"
    assert "z" not in harness.fleet.actors


def test_rollout_is_fenced_before_the_first_actor_has_joined() -> None:
    judge = RolloutJudge(run_spec(), EPOCH, Fleet(1, None))
    verdict = judge.read("a", encode(good()))
    assert isinstance(verdict, Rejected)
    assert (verdict.verdict, verdict.cause) == ("fenced", "unknown_actor")


@pytest.mark.parametrize("incarnation", [0, 2])
def test_rollout_of_an_incarnation_that_never_joined_is_fenced(harness: Harness, incarnation: int) -> None:
    data = encode(good(rollout_identity=identity(incarnation=incarnation)))
    assert_rejected(harness, data, "unknown_actor", f"incarnation {incarnation} of 'a' is not the current one of 'a'")


def test_rollout_of_a_replaced_incarnation_is_fenced(harness: Harness) -> None:
    harness.fleet.set_present("a", 1, False, 0.0)
    harness.fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=ENVIRONMENTS), 0.0)
    verdict = harness.receive(encode(good()))
    assert isinstance(verdict, Rejected)
    assert (verdict.verdict, verdict.cause) == ("fenced", "unknown_actor")
    assert isinstance(harness.receive(encode(good(rollout_identity=identity(incarnation=2)))), Rollout)


def test_rollout_is_fenced_if_its_incarnation_was_replaced_while_it_was_decoded(harness: Harness) -> None:
    content = harness.judge.read("a", encode(good()))
    assert isinstance(content, Rollout)
    harness.fleet.set_present("a", 1, False, 0.0)
    harness.fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=ENVIRONMENTS), 0.0)
    verdict = harness.judge.decide("a", content, VERSION, 0.0)
    assert isinstance(verdict, Rejected)
    assert (verdict.verdict, verdict.cause) == ("fenced", "unknown_actor")


def test_duplicate_is_rejected_after_the_incarnation_was_replaced_and_joined_again(harness: Harness) -> None:
    data = encode(good())
    assert isinstance(harness.receive(data), Rollout)
    for incarnation in (2, 1):
        harness.fleet.join(Join(actor="a", incarnation=incarnation, spaces=SPACES, environments=ENVIRONMENTS), 0.0)
    assert isinstance(harness.receive(data), Rejected)


def test_rollout_with_the_identity_of_another_actor_is_fenced(harness: Harness) -> None:
    assert_rejected(harness, encode(good(rollout_identity=identity("b"))), "unknown_actor", sender="a")
    assert not harness.fleet.actors["b"].rejected
    assert isinstance(harness.receive(encode(good(rollout_identity=identity("b"))), "b"), Rollout)


def test_duplicate_rollout_is_rejected(harness: Harness) -> None:
    assert isinstance(harness.receive(encode(good())), Rollout)
    assert assert_rejected(harness, encode(good()), "duplicate").reason == "the rollout was received before"


def test_stale_rollout_is_rejected_as_stale_first_and_as_duplicate_afterwards(harness: Harness) -> None:
    data = encode(good(version=VERSION - MAX_LAG - 1))
    verdicts = [harness.receive(data), harness.receive(data)]
    found = [(verdict.verdict, verdict.cause) for verdict in verdicts if isinstance(verdict, Rejected)]
    assert found == [("rejected", "stale"), ("rejected", "duplicate")]
    assert harness.fleet.actors["a"].accepted == 0


def test_a2c_rejects_older_versions_regardless_of_max_policy_lag() -> None:
    harness = Harness(algorithm="a2c")
    late = harness.receive(encode(good(version=VERSION - 1)))
    assert isinstance(late, Rejected)
    assert late.cause == "stale"
    assert isinstance(harness.receive(encode(good(rollout_identity=identity(sequence=1)))), Rollout)


def test_the_lag_bound_has_room_for_all_rollouts_in_flight_of_a_fleet_larger_than_expected() -> None:
    """Otherwise all rollouts of many actors would be rejected as too old, for as long as the learner is slower."""
    spec = run_spec(max_policy_lag=None)
    version = 200 * spec.collection.window // spec.batch_rollouts * spec.training.updates_per_batch
    assert version > spec.policy_lag_bound_with(0)
    rollout = encode(make_rollout(identity(actor="actor-7"), version=0))
    for names, accepted in ((["actor-7"], False), ([f"actor-{number}" for number in range(200)], True)):
        judge = RolloutJudge(spec, EPOCH, joined_fleet(*names))
        verdict = judge.decide("actor-7", judge.read("actor-7", rollout), version, 1.0)
        assert isinstance(verdict, Rollout) == accepted


# ------------------------------------------------------------------------------------------- quarantine


def broken(sequence: int) -> bytes:
    return encode(dataclasses.replace(with_value("rewards", np.nan), identity=identity(sequence=sequence)))


def verdicts(harness: Harness, *messages: bytes) -> list[str]:
    return [acknowledgement(harness.receive(data), VERSION).verdict for data in messages]


def test_actor_is_quarantined_after_three_unfit_rollouts_in_a_row(harness: Harness) -> None:
    fit = encode(good(rollout_identity=identity(sequence=9)))
    assert verdicts(harness, broken(0), broken(1)) == ["rejected", "rejected"]
    actor = harness.fleet.actors["a"]
    third, fourth = harness.receive(broken(2)), harness.receive(fit)
    assert third == Rejected(verdict="quarantined", cause="unfit", reason=actor.quarantined)
    assert fourth == Rejected(verdict="quarantined", cause="quarantined", reason=actor.quarantined)
    assert actor.quarantined == "3 unfit rollouts in a row, the last: rewards has a value that is not finite"
    assert actor.rejected == {"unfit": 3, "quarantined": 1}
    assert harness.fleet.live == {"b"}
    assert isinstance(harness.receive(encode(good(rollout_identity=identity("b"))), "b"), Rollout)


def test_valid_rollout_in_between_resets_the_count_of_unfit_rollouts(harness: Harness) -> None:
    fit = [encode(good(rollout_identity=identity(sequence=sequence))) for sequence in (10, 11)]
    assert "quarantined" not in verdicts(harness, broken(0), broken(1), fit[0], broken(2), broken(3), fit[1])


def test_quarantine_ends_with_a_new_incarnation_but_not_with_a_second_join(harness: Harness) -> None:
    verdicts(harness, broken(0), broken(1), broken(2))
    harness.fleet.join(Join(actor="a", incarnation=1, spaces=SPACES, environments=ENVIRONMENTS), 0.0)
    assert verdicts(harness, encode(good(rollout_identity=identity(sequence=5)))) == ["quarantined"]
    harness.fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=ENVIRONMENTS), 0.0)
    harness.fleet.set_present("a", 2, True, 0.0)
    assert harness.fleet.live == {"a", "b"}
    assert verdicts(harness, encode(good(rollout_identity=identity(incarnation=2)))) == ["accepted"]


def test_malformed_or_foreign_rollouts_do_not_quarantine_an_actor(harness: Harness) -> None:
    """A sender that does not know the incarnation and the learner epoch cannot quarantine an actor."""
    foreign = [identity(incarnation=8), identity(epoch=EPOCH + 1)]
    noise = [b"noise", encode(good())[:-1], *(encode(good(rollout_identity=each, rows=ROWS - 1)) for each in foreign)]
    assert "quarantined" not in verdicts(harness, *noise, *noise)
    assert verdicts(harness, encode(good())) == ["accepted"]


def test_rewards_outside_the_clip_range_are_rejected_as_unfit(harness: Harness) -> None:
    spec = run_spec(max_policy_lag=MAX_LAG)
    environment = spec.environment.model_copy(update={"reward_clip": 1.0, "reward_scale": 0.5})
    harness.judge = RolloutJudge(spec.model_copy(update={"environment": environment}), EPOCH, harness.fleet)
    within = good(rewards=np.full((ROWS, ENVIRONMENTS), -0.5 * (1 + 1e-5), np.float32))  # by rounding
    beyond = good(rollout_identity=identity(sequence=1), rewards=np.full((ROWS, ENVIRONMENTS), 0.51, np.float32))
    assert isinstance(harness.receive(encode(within)), Rollout)
    verdict = harness.receive(encode(beyond))
    assert isinstance(verdict, Rejected)
    assert verdict.reason == "rewards has a value outside the clip range of +-0.5"


def test_episode_length_of_0_is_rejected_as_unfit(harness: Harness) -> None:
    lengths = np.zeros_like(good().episode_lengths)
    verdict = assert_rejected(harness, encode(good(episode_lengths=lengths)), "unfit")
    assert verdict.reason == "episode_lengths has a value below 1"


def test_returns_of_episodes_that_did_not_end_are_rejected_as_unfit(harness: Harness) -> None:
    """100 invented returns once ended a run as solved."""
    none = np.zeros((ROWS, ENVIRONMENTS), np.bool_)
    invented = {"episode_returns": np.full(7, 500, np.float32), "episode_lengths": np.full(7, 500, np.int32)}
    rollout = good(terminated=none, truncated=none, valid=~none, **invented)
    assert_rejected(harness, encode(rollout), "unfit", "7 values, but 0 episodes ended")


def ending(sequence: int, length: int, value: float = 1.0) -> bytes:
    """Return a rollout in whose last row an episode of this length ends in each environment."""
    no = np.zeros((ROWS, ENVIRONMENTS), np.bool_)
    ends = no.copy()
    ends[-1] = True
    episodes = {
        "episode_returns": np.full(ENVIRONMENTS, value, np.float32),
        "episode_lengths": np.full(ENVIRONMENTS, length, np.int64),
    }
    return encode(
        good(rollout_identity=identity(sequence=sequence), terminated=ends, truncated=no, valid=~no, **episodes)
    )


def test_episodes_are_no_longer_than_the_rows_that_the_actor_has_sent(harness: Harness) -> None:
    """256 episodes of 500 env_steps in a first rollout of 512 rows once ended a run as solved."""
    assert_rejected(harness, ending(0, ROWS + 1), "unfit", f"has played at most {ROWS} rows in each of its 3 env")
    twice = Harness()
    assert isinstance(twice.receive(ending(0, ROWS)), Rollout)
    assert isinstance(twice.receive(ending(1, ROWS)), Rollout)
    verdict = twice.receive(ending(2, 2 * ROWS))
    assert isinstance(verdict, Rejected)
    assert f"episodes of {6 * ROWS} env_steps, the longest of {2 * ROWS}, and {6 * ROWS} before" in verdict.reason
    assert_rejected(Harness(), ending(0, 2**62), "unfit", "the longest of 4611686018427387904")


def test_rollouts_that_were_lost_count_as_far_as_others_have_arrived(harness: Harness) -> None:
    """A sequence number alone proves nothing."""
    assert_rejected(Harness(), ending(10**6, 100 * ROWS), "unfit", f"at most {4 * ROWS} rows")
    for sequence in range(0, 20, 2):
        assert isinstance(harness.receive(encode(good(rollout_identity=identity(sequence=sequence)))), Rollout)
    assert isinstance(harness.receive(ending(20, 15 * ROWS)), Rollout)


def test_a_client_may_have_played_rows_that_it_does_not_send() -> None:
    """As while a person steers: but no more than an environment can play in the time."""
    fleet = joined_fleet("a", environments=1)
    judge = RolloutJudge(run_spec(max_policy_lag=MAX_LAG), EPOCH, fleet)

    def verdict(length: int, sequence: int, now: float) -> Upload | Rejected:
        no, ends = np.zeros((2, ROWS, 1), np.bool_)
        ends[-1] = True
        episodes = {"episode_returns": np.ones(1, np.float32), "episode_lengths": np.full(1, length, np.int64)}
        rollout = good(
            rollout_identity=identity(sequence=sequence),
            environments=1,
            terminated=ends,
            truncated=no,
            valid=~no,
            **episodes,
        )
        return judge.decide("a", judge.read("a", encode(rollout)), VERSION, now)

    assert isinstance(verdict(100_000, 0, 1.0), Rollout)
    assert isinstance(verdict(1_000_000, 1, 10.0), Rejected)
    assert isinstance(verdict(1_000_000, 1, 200.0), Rollout)


@pytest.mark.parametrize("value", [1e12, -3e38])
def test_returns_that_no_rewards_add_up_to_are_rejected_as_unfit(harness: Harness, value: float) -> None:
    assert_rejected(harness, ending(0, ROWS, value), "unfit", "rewards within +-1e+09 do not add up to")


@pytest.mark.parametrize(
    ("ends", "valid", "reason"),
    [
        (False, False, "reset rule"),  # nothing was played
        (True, True, "reset rule"),  # an episode ends in every row
        (True, False, "a row that only resets"),
    ],
)
def test_rows_that_break_the_reset_rule_are_rejected_as_unfit(
    harness: Harness, ends: bool, valid: bool, reason: str
) -> None:
    rows = (ROWS, ENVIRONMENTS)
    count = ROWS * ENVIRONMENTS if ends else 0
    rollout = good(
        terminated=np.full(rows, ends),
        truncated=np.full(rows, ends),
        valid=np.full(rows, valid),
        episode_returns=np.zeros(count, np.float32),
        episode_lengths=np.ones(count, np.int32),
    )
    assert_rejected(harness, encode(rollout), "unfit", reason)


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ("reset", "a row that only resets is overridden"),
        ("all", "every row is overridden: there is none to learn from"),
    ],
)
def test_overridden_rows_that_no_client_sends_are_rejected_as_unfit(harness: Harness, rows: str, reason: str) -> None:
    plain = good()
    assert not plain.valid.all()
    overridden = ~plain.valid if rows == "reset" else plain.valid
    assert_rejected(harness, encode(good(overridden=overridden)), "unfit", reason)


def test_overridden_rows_are_accepted_and_not_counted() -> None:
    overridden = good().valid.copy()
    overridden[:-1] = False
    assert overridden.any()
    verdict = Harness().receive(encode(good(overridden=overridden)))
    assert isinstance(verdict, Rollout)
    assert verdict.env_steps == good().env_steps - np.count_nonzero(overridden)


@pytest.mark.parametrize(
    ("name", "largest", "reason"),
    [
        ("rewards", 1e9, "rewards has a value beyond +-1e+09: set environment.reward_scale"),
        ("frames", 1e15, "frames/observation has a value beyond +-1e+15: scale or clip the observations"),
        ("behaviour_log_probs", 1e6, "behaviour_log_probs has a value beyond +-1e+06"),
    ],
)
def test_values_that_no_gradient_survives_are_rejected_as_unfit(
    harness: Harness, name: str, largest: float, reason: str
) -> None:
    assert isinstance(Harness().receive(encode(with_value(name, -largest))), Rollout)
    assert_rejected(harness, encode(with_value(name, -1.01 * largest)), "unfit", reason)
    for value in (3e38, -3e38):
        verdict = Harness().receive(encode(with_value(name, value)))
        assert isinstance(verdict, Rejected)
        assert verdict.cause == "unfit"


@pytest.mark.parametrize("value", [1.01, -1.01, 3e38])
def test_state_that_no_gru_can_have_is_rejected_as_unfit(value: float) -> None:
    harness = Harness()
    harness.judge.state_size = 5
    state = np.ones((ENVIRONMENTS, 5), np.float32)
    assert isinstance(harness.receive(encode(good(initial_state=state))), Rollout)
    state[1, 2] = value
    verdict = harness.receive(encode(good(rollout_identity=identity(sequence=1), initial_state=state)))
    assert isinstance(verdict, Rejected)
    assert verdict.reason == "initial_state has a value beyond +-1.001"


# ---------------------------------------------------------------------------------------- at most once

TINY = vector_spaces(1, 4)
NAMES = st.sampled_from(["a", "b"])
SEQUENCES = st.one_of(st.integers(0, 6), st.integers(0, 3000), st.sampled_from([2**62, 2**62 - 1500, 2**63 - 1]))


class Traffic(RuleBasedStateMachine):
    """Model test with stale, duplicate, reordered and unfit rollouts, also from replaced and forgotten incarnations."""

    def __init__(self) -> None:
        super().__init__()
        self.fleet = Fleet(1, None)
        self.judge = RolloutJudge(run_spec(rows=1, max_policy_lag=2), EPOCH, self.fleet)
        self.version = 0
        self.now = 0.0
        self.newest = {"a": 0, "b": 0}  # the highest incarnation that joined; they count from 1
        self.incarnations = {"a": 0, "b": 0}  # the current incarnation; 0: none joined, or the actor was forgotten
        self.unfit = {"a": 0, "b": 0}  # in a row, of the incarnation that joined last
        self.remembered = {"a": 0, "b": 0}  # rollouts that were accepted since the actor was last forgotten
        self.barred: set[tuple[str, int]] = set()  # incarnations that were replaced, or quarantined and forgotten
        self.given_up: dict[tuple[str, int], int] = {}  # of forgotten incarnations, the highest number received
        self.taken: dict[tuple[str, int], set[int]] = {}
        self.accepted: list[tuple[str, int, int]] = []
        self.sent: list[tuple[str, Rollout]] = []  # accepted rollouts, with their senders

    @rule(name=NAMES)
    def new_incarnation_joins(self, name: str) -> None:
        self.newest[name] += 1
        self._join(name, self.newest[name])

    @rule(name=NAMES, older=st.integers(0, 2))
    def older_incarnation_joins_again(self, name: str, older: int) -> None:
        if self.newest[name] > older:
            self._join(name, self.newest[name] - older)

    def _join(self, name: str, incarnation: int) -> None:
        join = Join(actor=name, incarnation=incarnation, spaces=TINY, environments=1)
        refusal = self.fleet.join(join, self.now)
        assert (refusal is not None) == ((name, incarnation) in self.barred)
        previous = self.incarnations[name]
        if refusal is not None or previous == incarnation:
            return
        if previous:
            self.barred.add((name, previous))
        self.incarnations[name], self.unfit[name] = incarnation, 0

    @rule()
    def both_actors_are_forgotten(self) -> None:
        self.now += 100.0
        self.fleet.forget_absent(self.now)
        for name, incarnation in self.incarnations.items():
            if incarnation and self.unfit[name] == 3:
                self.barred.add((name, incarnation))
            self.given_up[name, incarnation] = max(self.taken.get((name, incarnation), set()), default=-1)
            self.incarnations[name] = self.remembered[name] = 0

    @rule()
    def learner_makes_an_update(self) -> None:
        self.version += 1

    @rule(
        name=NAMES,
        key=st.sampled_from(["own", "own", "own", "a", "b"]),
        older=st.sampled_from([0, 0, 0, 1]),
        sequence=SEQUENCES,
        lag=st.sampled_from([0, 0, 1, 2, 3, -1]),
        epoch=st.sampled_from([EPOCH, EPOCH, EPOCH, EPOCH + 1]),
        reward=st.sampled_from([1.0, 1.0, 1.0, np.nan, np.inf]),
    )
    def rollout_arrives(
        self, name: str, key: str, older: int, sequence: int, lag: int, epoch: int, reward: float
    ) -> None:
        sent = identity(name, sequence, max(self.newest[name] - older, 0), epoch)
        version = max(self.version - lag, 0)
        rewards = np.full((1, 1), reward, np.float32)
        rollout = make_rollout(sent, version=version, rows=1, environments=1, shape=(1,), rewards=rewards)
        self._deliver(name if key == "own" else key, rollout)

    @precondition(lambda self: self.sent)
    @rule(data=st.data())
    def accepted_rollout_arrives_again(self, data: st.DataObject) -> None:
        self._deliver(*data.draw(st.sampled_from(self.sent)))

    def _deliver(self, sender: str, rollout: Rollout) -> None:
        verdict = self.judge.decide(sender, self.judge.read(sender, encode(rollout)), self.version, self.now)
        expected = self._expected(sender, rollout)
        assert (verdict.cause if isinstance(verdict, Rejected) else "") == expected
        sent = rollout.identity
        if expected == "unfit":
            self.unfit[sender] += 1
            assert isinstance(verdict, Rejected)
            assert verdict.verdict == ("quarantined" if self.unfit[sender] == 3 else "rejected")
        if expected == "":
            self.unfit[sender] = 0
        if expected in ("", "stale"):
            self.taken.setdefault((sent.actor, sent.incarnation), set()).add(sent.sequence)
        if isinstance(verdict, Rollout):
            self.accepted.append((sent.actor, sent.incarnation, sent.sequence))
            self.remembered[sender] += 1
            self.sent.append((sender, rollout))

    def _expected(self, sender: str, rollout: Rollout) -> str:
        """Return the expected cause of rejection, or an empty string."""
        sent = rollout.identity
        if not self.incarnations[sender]:
            return "unknown_actor"
        if self.unfit[sender] == 3:
            return "quarantined"
        if sent.learner_epoch != EPOCH:
            return "epoch"
        if sent.actor != sender or sent.incarnation != self.incarnations[sender]:
            return "unknown_actor"
        if not np.isfinite(rollout.rewards).all():
            return "unfit"
        taken = self.taken.get((sent.actor, sent.incarnation), set())
        given_up = self.given_up.get((sent.actor, sent.incarnation), -1)
        if sent.sequence in taken or sent.sequence <= max(given_up, max(taken, default=0) - 1024):
            return "duplicate"
        if rollout.policy_version > self.version:
            return "unfit"
        return "stale" if self.version - rollout.policy_version > 2 else ""

    @invariant()
    def each_was_accepted_at_most_once(self) -> None:
        assert len(set(self.accepted)) == len(self.accepted)
        for name, actor in self.fleet.actors.items():
            assert bool(actor.quarantined) == (self.unfit[name] == 3)
            assert actor.accepted == self.remembered[name]


TestTraffic = Traffic.TestCase
TestTraffic.settings = settings(max_examples=300, stateful_step_count=40, deadline=None)
