"""learner/serving/rollout_judge.py: every cause of rejection, and acceptance at most once."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from building import ENVIRONMENTS, EPOCH, ROWS, SPACES, identity, joined_fleet, make_rollout, run_spec
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from plain import ACTION, NAME, plain, plain_spaces, vector_spaces

from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.rollout_judge import Rejected, RolloutJudge, acknowledgement
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Join, RunEnded, Snapshot
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout, Upload

VERSION, MAX_LAG = 10, 4
CELLS = (ROWS, ENVIRONMENTS)
FENCED = ("epoch", "unknown_actor")  # the causes for which an actor joins again


class Harness:
    """RolloutJudge with a fleet of actors `a` and `b`, at one policy version."""

    def __init__(self, *, spaces: Spaces = SPACES, state_size: int = 0, **training: Any) -> None:
        self.fleet = joined_fleet("a", "b", spaces=spaces)
        self.judge = RolloutJudge(run_spec(max_policy_lag=MAX_LAG, **training), EPOCH, self.fleet)
        self.judge.state_size = state_size

    def receive(self, data: bytes, sender: str = "a", now: float = 1.0) -> Upload | Rejected:
        return self.judge.decide(sender, self.judge.read(sender, data), VERSION, now)

    def memory(self) -> list[Any]:
        """Return the state of the fleet, without the fields that a rejection may change."""
        actors = [dataclasses.asdict(actor) for actor in self.fleet.actors.values()]
        return [
            self.fleet.spaces,
            [
                {**each, "last_seen": None, "longest_silence": None, "rejected": None, "consecutive_unfit": None}
                for each in actors
            ],
        ]


@pytest.fixture
def harness() -> Harness:
    return Harness()


def good(**replaced: Any) -> Rollout:
    return make_rollout(**{"version": VERSION, **replaced})


def assert_rejected(harness: Harness, data: bytes, cause: str, reason: str = "", sender: str = "a") -> Rejected:
    """Assert that a message is rejected and counted under `cause`, and that a valid rollout is accepted afterwards."""
    before = harness.memory()
    verdict = rejection(harness.receive(data, sender))
    assert (verdict.verdict, verdict.cause) == ("fenced" if cause in FENCED else "rejected", cause)
    assert reason in verdict.reason
    assert harness.memory() == before
    if sender in harness.fleet.actors:
        assert harness.fleet.actors[sender].rejected == {cause: 1}
    fit = good(rollout_identity=identity(sequence=1000), state_size=harness.judge.state_size)
    assert isinstance(harness.receive(encode(fit)), Rollout)
    return verdict


def with_value(name: str, value: float, sequence: int = 0) -> Rollout:
    """Return a valid rollout with one value of one array replaced."""
    value_of = getattr(good(), name)
    array = (plain(value_of) if isinstance(value_of, dict) else value_of).copy()
    array.flat[-1] = value
    return good(rollout_identity=identity(sequence=sequence), **{name: array})


def ending(sequence: int, length: int, value: float = 1.0, environments: int = ENVIRONMENTS) -> Rollout:
    """Return a rollout in whose last row an episode of this length ends in each environment."""
    no, ends = np.zeros((2, ROWS, environments), np.bool_)
    ends[-1] = True
    return good(
        rollout_identity=identity(sequence=sequence),
        environments=environments,
        terminated=ends,
        truncated=no,
        valid=~no,
        episode_returns=np.full(environments, value, np.float32),
        episode_lengths=np.full(environments, length, np.int64),
    )


def all_rows(*, ends: bool, valid: bool, episodes: int) -> Rollout:
    """Return a rollout whose rows are all alike, and that reports this number of episodes."""
    return good(
        terminated=np.full(CELLS, ends),
        truncated=np.full(CELLS, ends),
        valid=np.full(CELLS, valid),
        episode_returns=np.zeros(episodes, np.float32),
        episode_lengths=np.ones(episodes, np.int32),
    )


def rejection(verdict: Upload | Rejected | None) -> Rejected:
    assert isinstance(verdict, Rejected)
    return verdict


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


@pytest.mark.parametrize(
    "rollout",
    [
        good(version=VERSION - MAX_LAG),
        with_value("behaviour_log_probs", 0.99e-4),  # above 0 by rounding
        with_value("rewards", -1e9),
        with_value("frames", -1e15),
        with_value("behaviour_log_probs", -1e6),
        good(overridden=good().valid & (np.arange(ROWS) == ROWS - 1)[:, None]),
        good(episode_info={f"{number:064}": np.ones(len(good().episode_returns), np.float32) for number in range(16)}),
    ],
    ids=["lag", "log-probability", "reward", "frame", "unlikely action", "overridden rows", "all info"],
)
def test_rollout_at_a_bound_is_accepted(harness: Harness, rollout: Rollout) -> None:
    verdict = harness.receive(encode(rollout))
    assert isinstance(verdict, Rollout)
    assert verdict.env_steps == rollout.env_steps
    assert verdict.episode_info.keys() == rollout.episode_info.keys()


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


@pytest.mark.parametrize(("observations", "actions", "most"), [("a", "c", 36), ("ab", "cde", 41)])
def test_message_with_many_arrays_is_rejected_as_malformed(observations: str, actions: str, most: int) -> None:
    """A component of the observation has one array, a component of the action two, with its masks."""
    spaces = Spaces(
        observations=dict.fromkeys(observations, ArraySpace(shape=(3,), dtype="float32")),
        actions=dict.fromkeys(actions, DiscreteSpace(counts=(4,))),
    )
    weights = {str(number): np.zeros(1, np.float32) for number in range(most + 1)}
    data = encode(Snapshot(learner_epoch=EPOCH, policy_version=0, program="", weights=weights))
    verdict = rejection(Harness(spaces=spaces).receive(data))
    assert (verdict.cause, verdict.reason) == ("malformed", f"{most + 1} arrays, the limit is {most}")


def test_message_of_another_type_is_rejected_as_malformed(harness: Harness) -> None:
    data = encode(RunEnded(learner_epoch=EPOCH, outcome="finished", reason=""))
    assert assert_rejected(harness, data, "malformed").reason == "the message is not a rollout"


def shape_reason(rollout: Rollout) -> str:
    return f"the rollout has {rollout.rows} rows of {rollout.environments} environments, expected {ROWS} rows of"


WRONG_ROWS = [
    good(rows=ROWS - 1),
    good(rows=ROWS + 1),
    good(environments=ENVIRONMENTS - 1),
    good(environments=ENVIRONMENTS + 1),
    good(rows=ROWS - 1, stack=2),  # the expected number of frames
]
WRONG_FRAMES = [
    good(shape=(4,)),
    good(shape=(2,)),
    good(shape=(3, 1)),
    good(stack=2),
    good(frames=np.zeros((ROWS + 1, ENVIRONMENTS, 3), np.uint8)),
]
FLOATS = ("frames", "behaviour_log_probs", "rewards", "episode_returns")
NO_NUMBERS = (np.nan, np.inf, -np.inf)


def with_action(action: int) -> np.ndarray:
    actions = plain(good().actions)[..., 0].astype(np.int32)
    actions[-1, -1] = action
    return actions


def state_with(value: float) -> np.ndarray:
    state = np.zeros((ENVIRONMENTS, 5))
    state[-1, -1] = value
    return state


@pytest.mark.parametrize(
    ("rollout", "reason"),
    [
        *((rollout, shape_reason(rollout)) for rollout in WRONG_ROWS),
        *((rollout, f"frames/observation is {plain(rollout.frames).dtype}") for rollout in WRONG_FRAMES),
        *((rollout, f"expected float32 {(ROWS + 1, ENVIRONMENTS, 3)}") for rollout in WRONG_FRAMES),
        *((good(state_size=size), f"initial_state has size {size}, expected 0") for size in (1, 7)),
        *((good(actions=with_action(action)), "actions/action has a value") for action in (-1, 4, 2**31 - 1)),
        *((with_value(name, value), name) for name in FLOATS for value in (*NO_NUMBERS, 3e38, -3e38)),
        *((good(episode_info={"x": np.full(1, value, np.float32)}), "episode_info 'x'") for value in (np.nan, np.inf)),
        (with_value("behaviour_log_probs", 1.01e-4), "behaviour_log_probs has a value above 0"),
        (good(version=VERSION + 1), "is newer than the learner's version"),
        (good(episode_lengths=np.zeros_like(good().episode_lengths)), "episode_lengths has a value below 1"),
        # 100 invented returns once ended a run as solved.
        (all_rows(ends=False, valid=True, episodes=7), "7 values, but 0 episodes ended"),
        (ending(0, ROWS + 1), f"has played at most {ROWS} rows in each of its 3 env"),
        (ending(0, 2**62), "the longest of 4611686018427387904"),
        (ending(10**6, 100 * ROWS), f"at most {4 * ROWS} rows"),  # a sequence number alone proves nothing
        (ending(0, ROWS, 1e12), "rewards within +-1e+09 do not add up to"),
        (ending(0, ROWS, -3e38), "rewards within +-1e+09 do not add up to"),
        (all_rows(ends=False, valid=False, episodes=0), "reset rule"),  # nothing was played
        (all_rows(ends=True, valid=True, episodes=ROWS * ENVIRONMENTS), "reset rule"),
        (all_rows(ends=True, valid=False, episodes=ROWS * ENVIRONMENTS), "a row that only resets"),
        (good(overridden=~good().valid), "a row that only resets is overridden"),
        (good(overridden=good().valid), "every row is overridden: there is none to learn from"),
        (good(overridden=good().valid, taught=good().valid), "every row is overridden: there is none to learn from"),
        (good(taught=good().valid), "a row is taught that is not overridden"),
        # Values that no gradient survives.
        (with_value("rewards", -1.01e9), "rewards has a value beyond +-1e+09: set environment.reward_scale"),
        (with_value("frames", -1.01e15), "frames/observation has a value beyond +-1e+15: scale or clip the obs"),
        (with_value("behaviour_log_probs", -1.01e6), "behaviour_log_probs has a value beyond +-1e+06"),
    ],
)
def test_unfit_rollout_is_rejected_with_its_fault_named(harness: Harness, rollout: Rollout, reason: str) -> None:
    assert_rejected(harness, encode(rollout), "unfit", reason)


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        *((np.zeros((ENVIRONMENTS, size)), f"initial_state has size {size}, expected 5") for size in (0, 4, 6)),
        *((state_with(value), "initial_state has a value that is not finite") for value in NO_NUMBERS),
        *((state_with(value), "initial_state has a value beyond +-1.001") for value in (1.01, -1.01, 3e38)),
    ],
)
def test_recurrent_state_that_no_gru_of_the_run_can_have_is_rejected(state: np.ndarray, reason: str) -> None:
    harness = Harness(state_size=5)
    assert assert_rejected(harness, encode(good(initial_state=state.astype(np.float32))), "unfit").reason == reason
    ones = np.ones((ENVIRONMENTS, 5), np.float32)
    assert isinstance(harness.receive(encode(good(initial_state=ones))), Rollout)


def test_oversized_rollout_is_rejected_before_it_is_unpacked(harness: Harness) -> None:
    bomb = good(rows=4000, environments=500, frames=np.zeros((4001, 500, 3), np.float32))
    assert_rejected(harness, encode(bomb), "malformed", "the limit is")


# ----------------------------------------------------------------------------------------------- stacks

STACKED = ArraySpace(shape=(60, 80, 3), dtype="uint8", frames=4)
PICTURES = plain_spaces(STACKED, 4)


def pixels(length: int = ROWS + 4, shape: tuple[int, ...] = STACKED.shape) -> np.ndarray:
    """Return noise, which is not compressible."""
    return np.random.default_rng(0).integers(0, 256, (length, ENVIRONMENTS, *shape), np.uint8)


def test_stacked_observations_are_sent_as_single_frames_in_either_memory_layout() -> None:
    for frames in (pixels(), np.ascontiguousarray(pixels().swapaxes(0, 1)).swapaxes(0, 1)):
        verdict = Harness(spaces=PICTURES).receive(encode(good(frames=frames)))
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
    verdict = Harness(spaces=PICTURES).receive(encode(good(frames=frames)))
    assert isinstance(verdict, Rejected)
    assert ("the limit is" if verdict.cause == "malformed" else "frames/observation is uint8") in verdict.reason


def test_size_limit_accepts_the_largest_valid_rollout_and_rejects_twice_its_frames() -> None:
    every_second = np.broadcast_to((np.arange(ROWS) % 2 == 0)[:, None], CELLS).copy()
    most = int(every_second.sum())  # episodes of one row, each followed by a reset row
    largest = good(
        frames=pixels(),
        initial_state=np.zeros((ENVIRONMENTS, 40_000), np.float32),
        actions=plain(good().actions)[..., 0].astype(np.int64),
        terminated=every_second,
        truncated=np.zeros_like(every_second),
        valid=every_second,
        episode_returns=np.zeros(most, np.float32),
        episode_lengths=np.ones(most, np.int64),
    )
    assert isinstance(Harness(spaces=PICTURES, state_size=40_000).receive(encode(largest)), Rollout)
    verdict = rejection(Harness(spaces=PICTURES).receive(encode(good(frames=pixels(2 * (ROWS + 4))))))
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
    harness = Harness(spaces=Spaces(observations={NAME: STACKED}, actions={ACTION: action}), state_size=7)
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
    verdict = rejection(RolloutJudge(run_spec(), EPOCH, Fleet(1, None)).read("a", encode(good())))
    assert (verdict.verdict, verdict.cause) == ("fenced", "unknown_actor")


@pytest.mark.parametrize("incarnation", [0, 2])
def test_rollout_of_an_incarnation_that_never_joined_is_fenced(harness: Harness, incarnation: int) -> None:
    data = encode(good(rollout_identity=identity(incarnation=incarnation)))
    assert_rejected(harness, data, "unknown_actor", f"incarnation {incarnation} of 'a' is not the current one of 'a'")


@pytest.mark.parametrize("decoded_before", [False, True])
def test_rollout_of_a_replaced_incarnation_is_fenced(harness: Harness, decoded_before: bool) -> None:
    data = encode(good())
    content = harness.judge.read("a", data)
    assert isinstance(content, Rollout)
    harness.fleet.set_present("a", 1, False, 0.0)
    harness.fleet.join(Join(actor="a", incarnation=2, spaces=SPACES, environments=ENVIRONMENTS), 0.0)
    verdict = harness.judge.decide("a", content, VERSION, 0.0) if decoded_before else harness.receive(data)
    assert (rejection(verdict).verdict, rejection(verdict).cause) == ("fenced", "unknown_actor")
    assert isinstance(harness.receive(encode(good(rollout_identity=identity(incarnation=2)))), Rollout)


def test_rollout_with_the_identity_of_another_actor_is_fenced(harness: Harness) -> None:
    assert_rejected(harness, encode(good(rollout_identity=identity("b"))), "unknown_actor", sender="a")
    assert not harness.fleet.actors["b"].rejected
    assert isinstance(harness.receive(encode(good(rollout_identity=identity("b"))), "b"), Rollout)


@pytest.mark.parametrize(("lag", "first"), [(0, "accepted"), (MAX_LAG + 1, "stale")])
def test_rollout_that_arrives_again_is_rejected_as_duplicate(harness: Harness, lag: int, first: str) -> None:
    data = encode(good(version=VERSION - lag))
    verdict = harness.receive(data)
    assert (verdict.cause if isinstance(verdict, Rejected) else "accepted") == first
    assert rejection(harness.receive(data)).reason == "the rollout was received before"
    assert harness.fleet.actors["a"].accepted == (first == "accepted")


def test_a2c_rejects_older_versions_regardless_of_max_policy_lag() -> None:
    harness = Harness(algorithm="a2c")
    assert rejection(harness.receive(encode(good(version=VERSION - 1)))).cause == "stale"
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
    return encode(with_value("rewards", np.nan, sequence))


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
    within = good(rewards=np.full(CELLS, -0.5 * (1 + 1e-5), np.float32))  # by rounding
    assert isinstance(harness.receive(encode(within)), Rollout)
    beyond = good(rollout_identity=identity(sequence=1), rewards=np.full(CELLS, 0.51, np.float32))
    assert rejection(harness.receive(encode(beyond))).reason == "rewards has a value outside the clip range of +-0.5"


def test_episodes_are_no_longer_than_the_rows_that_the_actor_has_sent(harness: Harness) -> None:
    """256 episodes of 500 env_steps in a first rollout of 512 rows once ended a run as solved."""
    for sequence in range(2):
        assert isinstance(harness.receive(encode(ending(sequence, ROWS))), Rollout)
    verdict = rejection(harness.receive(encode(ending(2, 2 * ROWS))))
    assert f"episodes of {6 * ROWS} env_steps, the longest of {2 * ROWS}, and {6 * ROWS} before" in verdict.reason


def test_rollouts_that_were_lost_count_as_far_as_others_have_arrived(harness: Harness) -> None:
    for sequence in range(0, 20, 2):
        assert isinstance(harness.receive(encode(good(rollout_identity=identity(sequence=sequence)))), Rollout)
    assert isinstance(harness.receive(encode(ending(20, 15 * ROWS))), Rollout)


def test_a_client_may_have_played_rows_that_it_does_not_send() -> None:
    """As while a person steers: but no more than an environment can play in the time."""
    harness = Harness()
    harness.judge = RolloutJudge(run_spec(max_policy_lag=MAX_LAG), EPOCH, joined_fleet("a", environments=1))
    played = [(100_000, 0, 1.0), (1_000_000, 1, 10.0), (1_000_000, 1, 200.0)]
    verdicts = [harness.receive(encode(ending(n, length, environments=1)), now=now) for length, n, now in played]
    assert [isinstance(verdict, Rollout) for verdict in verdicts] == [True, False, True]


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
TestTraffic.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
