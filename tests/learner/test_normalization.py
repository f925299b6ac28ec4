"""algorithms/normalization.py, running_returns.py: statistics equal those of all values, however they arrive."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from building import POLICY, identity, join, make_rollout
from plain import NAME, plain

from daedalus.algorithms import normalization
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.normalization import (
    ConfirmedRanges,
    Moments,
    ObservationStatistics,
    RewardNormalizer,
    RunningMoments,
    moments_of,
    observations_name,
)
from daedalus.algorithms.running_returns import Streams
from daedalus.policy.component_inputs import normalized_components
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.encoders import build_codes
from daedalus.policy.network.observation_normalizer import ObservationNormalizer
from daedalus.protocol.spaces import ActionSpace, ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec
from daedalus.protocol.uploads import Rollout

DISCOUNT = 0.9
ACTIONS: dict[str, ActionSpace] = {"action": DiscreteSpace(counts=(4,))}


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_moments_of_batches_equal_those_of_all_values(offset: float) -> None:
    values = offset + np.random.default_rng(1).standard_normal((100, 2, 3))
    moments = RunningMoments((2, 3))
    assert moments.variance.eq(1.0).all()
    for part in np.split(values, [1, 2, 30, 30, 77]):  # one is empty
        moments.add(torch.from_numpy(part))
    assert moments.count.eq(100).all()
    np.testing.assert_allclose(moments.mean, values.mean(0), rtol=1e-12)
    np.testing.assert_allclose(moments.variance, values.var(0), rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_moments_of_large_values_are_computed_in_parts(monkeypatch: pytest.MonkeyPatch, dtype: type) -> None:
    values = torch.from_numpy(np.random.default_rng(1).integers(0, 256, (100, 2, 3)).astype(dtype))
    whole = moments_of(values)
    monkeypatch.setattr(normalization, "_PART_NUMBERS", 50)
    parts: list[int] = []
    merge = RunningMoments.merge
    monkeypatch.setattr(RunningMoments, "merge", lambda self, each: (parts.append(each.number), merge(self, each)))
    moments = moments_of(values)
    assert parts == [8] * 12 + [4]
    assert moments.number == 100
    np.testing.assert_allclose(moments.mean, whole.mean, rtol=1e-12)
    np.testing.assert_allclose(moments.squares, whole.squares, rtol=1e-12)


def discounted_sums(rollouts: list[Rollout]) -> list[float]:
    """Return G of every valid row of consecutive rollouts of one actor, one environment after another."""
    found = []
    for environment in range(rollouts[0].environments):
        rewards_so_far: list[float] = []
        for rollout in rollouts:
            for row in range(rollout.rows):
                rewards_so_far.append(float(rollout.rewards[row, environment]))
                if rollout.valid[row, environment]:
                    found.append(sum(reward * DISCOUNT**age for age, reward in enumerate(reversed(rewards_so_far))))
                if rollout.terminated[row, environment] or rollout.truncated[row, environment]:
                    rewards_so_far.clear()
    return found


def add(normalizer: RewardNormalizer, rollouts: list[Rollout]) -> None:
    normalizer.moments.merge(normalizer.moments_of(rollouts))


def observe(statistics: ObservationStatistics, batch: Batch) -> None:
    ranges, moments = ConfirmedRanges(), statistics.moments_of(batch)
    ranges.vote("a", {observations_name(name): each for name, each in moments.items()})
    statistics.merge({name: [each] for name, each in moments.items()}, ranges)


def sent(sequence: int, actor: str = "a", incarnation: int = 1, environments: int = 3) -> Rollout:
    rollout = make_rollout(
        identity(actor, sequence, incarnation), seed=10 * sequence + ord(actor), environments=environments
    )
    first = np.ones((1, environments), np.bool_) if not sequence else rollout.valid[:1]
    valid = np.concatenate([first, rollout.valid[1:]])
    # Rewards of reset rows are 0, as actors send them, and such a row ends no episode.
    terminated, truncated = rollout.terminated & valid, rollout.truncated & valid
    return replace(rollout, valid=valid, terminated=terminated, truncated=truncated, rewards=rollout.rewards * valid)


STREAMS = {
    "one stream": [[sent(0), sent(1), sent(2)]],
    "two actors": [[sent(0), sent(1)], [sent(0, "b"), sent(1, "b")]],
    "a gap": [[sent(0), sent(1)], [sent(3), sent(4)]],
    "a new incarnation": [[sent(0), sent(1)], [sent(2, incarnation=2)]],
    "a new epoch": [[sent(0), sent(1)], [sent(0), sent(1)]],
    "other environments": [[sent(0), sent(1)], [sent(2, environments=2)]],
}


@pytest.mark.parametrize("streams", STREAMS.values(), ids=STREAMS)
@pytest.mark.parametrize("size", [1, 2, 9])
def test_returns_run_on_over_the_rollouts_of_a_stream(streams: list[list[Rollout]], size: int) -> None:
    normalizer = RewardNormalizer(DISCOUNT)
    rollouts = [rollout for stream in streams for rollout in stream]
    if len({each.identity.actor for each in rollouts}) > 1:
        rollouts.sort(key=lambda rollout: rollout.identity.sequence)  # the actors take turns
    for start in range(0, len(rollouts), size):
        add(normalizer, rollouts[start : start + size])
    expected = [value for stream in streams for value in discounted_sums(stream)]
    assert normalizer.moments.count == len(expected)
    assert float(normalizer.moments.mean) == pytest.approx(np.mean(expected), rel=1e-5)
    assert float(normalizer.moments.variance) == pytest.approx(np.var(expected), rel=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("ends", [True, False])
def test_a_reward_that_is_not_finite_does_not_reach_the_next_episode_or_rollout(bad: float, ends: bool) -> None:
    """The learner rejects such a rollout; an actor that computes gradients goes on after it."""
    nowhere, everywhere = np.zeros((6, 3), np.bool_), np.ones((6, 3), np.bool_)
    first = replace(sent(0), valid=everywhere, terminated=nowhere.copy(), truncated=nowhere)
    first.rewards[2] = bad
    first.terminated[3] = ends
    normalizer = RewardNormalizer(DISCOUNT)
    returns = normalizer._returns.add(first)
    assert np.isfinite(returns).all(1).tolist() == [True, True, False, False, ends, ends]
    assert normalizer.moments_of([sent(1)]).squares.isfinite()


def test_rewards_are_divided_by_the_deviation_and_clipped() -> None:
    normalizer = RewardNormalizer(DISCOUNT)
    add(normalizer, [sent(0)])
    batch = join([sent(1)])
    batch.rewards[0, 0] = 1e6
    rewards = batch.rewards.clone()
    normalizer.scale(batch)
    deviation = float(normalizer.moments.variance) ** 0.5
    np.testing.assert_allclose(batch.rewards, (rewards / deviation).clip(-10.0, 10.0), rtol=1e-5)
    assert batch.rewards[0, 0] == 10.0


@pytest.mark.parametrize("offset", [100.0, -1e5])
def test_rewards_that_differ_little_beside_their_mean_stay_different(offset: float) -> None:
    """As with episodes of one step: divided by their deviation, all would be clipped to the same value."""
    normalizer = RewardNormalizer(DISCOUNT)
    rewards = offset + torch.tensor([0.0, 1.0], dtype=torch.float64).repeat(50)
    normalizer.moments.add(rewards)
    batch = join([sent(1)])
    batch.rewards[0] = torch.tensor([offset, offset + 1.0, 0.0])
    normalizer.scale(batch)
    lower, higher, none = batch.rewards[0].tolist()
    assert none == 0.0
    assert 4.9 < abs(lower) < 5.1
    assert higher - lower == pytest.approx(5.0 / abs(offset), rel=0.05)


def played(sequence: int, begin: int, reward: float, *, rows: int = 16, stack: int = 1) -> Rollout:
    """Return a rollout of one agent without an end, whose newest frames count on from `begin`."""
    frames = begin + 1 - stack + np.arange(rows + stack, dtype=np.float32)
    nowhere = np.zeros((rows, 1), np.bool_)
    return make_rollout(
        identity("a", sequence),
        rows=rows,
        environments=1,
        frames=frames[:, None, None].repeat(3, 2),
        rewards=np.full((rows, 1), reward, np.float32),
        terminated=nowhere,
        truncated=nowhere,
        valid=~nowhere,
        episode_returns=np.zeros(0, np.float32),
        episode_lengths=np.zeros(0, np.int32),
    )


@pytest.mark.parametrize("stack", [1, 4])
def test_returns_of_the_agents_of_a_client_run_on_agent_by_agent(stack: int) -> None:
    """One agent's rewards are 1, the other's -1: mixed, the returns would be near 0."""
    normalizer = RewardNormalizer(0.99)
    rounds = 60
    for turn in range(rounds):
        add(normalizer, [played(2 * turn, 16 * turn, 1.0, stack=stack)])
        add(normalizer, [played(2 * turn + 1, 10_000 + 16 * turn, -1.0, stack=stack)])
    returns = (1.0 - 0.99 ** np.arange(1, 16 * rounds + 1)) / 0.01
    expected = np.concatenate([returns, -returns]).std()
    assert float(normalizer.moments.variance) ** 0.5 == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("synchronous", [True, False])
def test_returns_of_one_agent_run_on_whatever_few_observations_it_has(synchronous: bool) -> None:
    normalizer = RewardNormalizer(0.9, synchronous=synchronous)
    random, first, rows = np.random.default_rng(1), 0.0, 4
    for sequence in range(100):
        rollout = played(sequence, 0, 1.0, rows=rows)
        rollout.frames[NAME][0], rollout.frames[NAME][-1] = first, random.integers(4)
        first = rollout.frames[NAME][-1].copy()
        add(normalizer, [rollout])
    expected = (1.0 - 0.9 ** np.arange(1, 100 * rows + 1)) / 0.1
    assert float(normalizer.moments.mean) == pytest.approx(expected.mean(), rel=1e-6)


def test_returns_run_on_over_rows_that_a_client_does_not_send() -> None:
    """As in runs of a2c, while the client waits for the next policy."""
    normalizer = RewardNormalizer(0.5, synchronous=True)
    add(normalizer, [played(0, 0, 1.0), played(1, 100, 1.0)])
    expected = (1.0 - 0.5 ** np.arange(1, 33)) / 0.5
    assert float(normalizer.moments.mean) == pytest.approx(expected.mean(), rel=1e-6)


def test_owner_of_the_largest_streams_forgets_the_first_of_them() -> None:
    streams = Streams[int](most=6)
    for number, actor in enumerate(["small", "large.0", "large.1"]):
        streams.put(make_rollout(identity(actor, 0)), number, size=2)
    assert not streams.has_forgotten
    streams.put(make_rollout(identity("large.2", 0)), 3, size=4)  # the first two of this owner are enough
    assert streams.has_forgotten
    assert [streams.take(make_rollout(identity(f"large.{index}", 1))) for index in range(3)] == [None, None, 3]
    streams.put(make_rollout(identity("huge", 0)), 4, size=7)  # more than all may have
    assert streams.take(make_rollout(identity("huge", 1))) is None
    assert streams.take(make_rollout(identity("small", 1))) == 0
    assert streams.take(make_rollout(identity("small", 1))) is None


def test_observations_of_valid_rows_are_counted_once_in_each_component() -> None:
    spaces = {
        NAME: ArraySpace(shape=(3,), dtype="float32"),
        "bytes": ArraySpace(shape=(2,), dtype="uint8"),
        "kinds": ArraySpace(shape=(2, 1), dtype="uint8"),
        "image": ArraySpace(shape=(16, 16), dtype="uint8"),
        "choice": DiscreteSpace(counts=(3,)),
    }
    policy = PolicySpec(normalize_observations=True, codes={"kinds": (4,)})
    normalizer = ObservationNormalizer(normalized_components(policy, spaces))
    assert normalizer.names == (NAME, "bytes", "kinds")
    statistics = ObservationStatistics(normalizer, build_codes(policy, spaces))
    random, seen = np.random.default_rng(2), {NAME: [], "bytes": [], "kinds": []}
    for seed in range(3):
        rollout = make_rollout(seed=seed)
        more = {
            "bytes": random.integers(0, 256, (7, 3, 2), np.uint8),
            "kinds": random.integers(0, 4, (7, 3, 2, 1), np.uint8),
            "image": random.integers(0, 256, (7, 3, 16, 16), np.uint8),
            "choice": random.integers(0, 3, (7, 3, 1), np.uint8),
        }
        rollout = replace(rollout, frames={NAME: plain(rollout.frames), **more})
        observe(statistics, join([rollout], Spaces(observations=spaces, actions=ACTIONS)))
        for name, values in seen.items():
            frames = rollout.frames[name][:-1][rollout.valid]
            values.append(frames == np.arange(4) if name == "kinds" else frames)  # as one-hot numbers
    for name, values in seen.items():
        mean, variance = normalizer.statistics(name)
        np.testing.assert_allclose(mean, np.concatenate(values).astype(np.float64).mean(0), rtol=1e-4)
        np.testing.assert_allclose(
            variance, np.concatenate(values).astype(np.float64).var(0), rtol=2**-7
        )  # of bfloat16


def test_statistics_that_came_with_weights_change_slowly() -> None:
    spaces = Spaces(observations={NAME: ArraySpace(shape=(3,), dtype="float32")}, actions=ACTIONS)
    network = ActorCritic(POLICY.model_copy(update={"normalize_observations": True}), spaces)
    network.normalizer.set_statistics(NAME, torch.full((3,), 50.0), torch.full((3,), 4.0))
    statistics = ObservationStatistics(network.normalizer, network.codes)
    statistics.take_from_network()
    observe(statistics, join([make_rollout()]))
    mean, variance = network.normalizer.statistics(NAME)
    assert ((mean - 50.0).abs() < 0.1).all()
    assert ((variance - 4.0).abs() < 0.5).all()


# ------------------------------------------------------------------------- what one rollout or actor cannot spoil


class Votes:
    """Running moments of one component [2], from rollouts of 100 rows: what they are, and who was far outside."""

    def __init__(self) -> None:
        self.moments, self.ranges, self.far = RunningMoments((2,)), ConfirmedRanges(), list[str]()
        self.random = np.random.default_rng(1)
        self.honest: list[np.ndarray] = []

    def send(self, actor: str, values: np.ndarray, *, is_honest: bool = True) -> None:
        moments = moments_of(torch.from_numpy(values.astype(np.float64)))
        if self.ranges.vote(actor, {"x": moments}):
            self.far.append(actor)
        else:
            self.ranges.merge("x", [moments], self.moments)
        if is_honest:
            self.honest.append(values)

    def play(self, actors: str, rollouts: int, *, mean: float = 0.0, deviation: float = 1.0) -> None:
        """Let actors send honest rollouts in turns."""
        for turn in range(rollouts):
            self.send(actors[turn % len(actors)], mean + deviation * self.random.standard_normal((100, 2)))

    def signs(self, size: float) -> np.ndarray:
        return size * self.random.choice([-1.0, 1.0], (100, 2))

    @property
    def deviation(self) -> np.ndarray:
        return self.moments.variance.sqrt().numpy()

    @property
    def expected(self) -> np.ndarray:
        return np.concatenate(self.honest).std(0)


@pytest.mark.parametrize("size", [30.0, 1e4, 9e14])
@pytest.mark.parametrize("constant", [True, False])
@pytest.mark.parametrize("before", [0, 1, 50])
@pytest.mark.parametrize("actors", ["a", "ab"])
def test_one_rollout_does_not_spoil_the_statistics(actors: str, before: int, constant: bool, size: float) -> None:
    """Nor if it is the first one. Averaged in, it would: by a factor of 1e12 after 200 more."""
    votes = Votes()
    votes.play(actors, before)
    votes.send("a", np.full((100, 2), -size) if constant else votes.signs(size), is_honest=False)
    votes.play(actors, 100)
    assert (votes.deviation < 2.0).all()
    assert (votes.deviation > 0.9).all()
    assert (votes.moments.mean.abs() < 0.5).all()


@pytest.mark.parametrize("size", [30.0, 1e4, 9e14])
def test_an_actor_that_sends_much_does_not_spoil_the_statistics(size: float) -> None:
    """Whether it sends a sixth, as here, or begins before the others."""
    for first in (0, 20):
        votes = Votes()
        for _ in range(first):
            votes.send("z", votes.signs(size), is_honest=False)
        for _ in range(100):
            votes.play("abcde", 5)
            votes.send("z", votes.signs(size), is_honest=False)
        assert (votes.deviation < 6.0).all()
        assert set(votes.far) == ({"z"} if size > 1e5 else set())


def test_actors_of_one_owner_do_not_confirm_each_other() -> None:
    votes = Votes()
    for turn in range(100):
        votes.play("ab", 2)
        votes.send(f"z.{turn % 10}", votes.signs(1e4), is_honest=False)
    assert (votes.deviation < 3.0).all()


def one_hot(votes: Votes, actor: str, share: float) -> np.ndarray:
    return (votes.random.random((100, 2)) < share).astype(np.float64)


HONEST = {
    "numbers": lambda votes, actor, turn: votes.random.standard_normal((100, 2)),
    "large numbers that differ little": lambda votes, actor, turn: 1e5 + votes.random.standard_normal((100, 2)),
    "tiny numbers": lambda votes, actor, turn: 1e-6 * votes.random.standard_normal((100, 2)),
    "sparse flags": lambda votes, actor, turn: one_hot(votes, actor, 0.003),
    "a flag of each actor": lambda votes, actor, turn: np.full((100, 2), [actor == "a", actor == "b"], np.float64),
    "constants": lambda votes, actor, turn: np.full((100, 2), [0.0, 0.1]),
    "a position that moves on": lambda votes, actor, turn: turn + votes.random.standard_normal((100, 2)),
    "one that grows": lambda votes, actor, turn: 1.05**turn * votes.random.standard_normal((100, 2)),
    "few values": lambda votes, actor, turn: votes.random.integers(0, 256, (100, 2)).astype(np.float64),
}


@pytest.mark.parametrize("actors", ["a", "ab", "abc"])
@pytest.mark.parametrize("values", HONEST.values(), ids=HONEST)
def test_honest_numbers_count_in_full(values: Callable[[Votes, str, int], np.ndarray], actors: str) -> None:
    votes = Votes()
    for turn in range(150):
        actor = actors[turn % len(actors)]
        votes.send(actor, values(votes, actor, turn))
    assert not votes.far
    np.testing.assert_allclose(votes.deviation, votes.expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(votes.moments.mean, np.concatenate(votes.honest).mean(0), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("actors", ["a", "abcdefgh"])
@pytest.mark.parametrize(("before", "after"), [(0.0, 1.0), (0.0, 1000.0), (1.0, 1000.0), (1.0, 1e5), (1e-3, 1.0)])
def test_numbers_that_jump_are_followed(actors: str, before: float, after: float) -> None:
    """As when the goal is found for the first time, or a sensor that was constant is used."""
    votes = Votes()
    votes.play(actors, 1000, deviation=before)
    votes.honest.clear()
    votes.play(actors, 24, deviation=after)
    assert not votes.far
    share = 24 / 1024
    assert (votes.deviation > 0.5 * after * share**0.5).all()


@pytest.mark.parametrize("actors", ["a", "ab", "abcdefgh"])
def test_rare_rewards_that_are_much_larger_are_neither_far_outside_nor_forgotten(actors: str) -> None:
    """A goal worth 1,000 in one rollout of twenty, and -0.01 for each row elsewhere."""
    votes = Votes()
    for turn in range(600):
        found = votes.random.random() < 0.05
        votes.send(
            actors[turn % len(actors)], np.full((100, 2), -0.01) + (found * 1000.0) * (np.arange(100) > 90)[:, None]
        )
    assert not votes.far
    assert (votes.deviation > 1.0).all()
    # What counts of the goal is far above the largest that the network sees of it, 10 deviations.
    assert (1000.0 / votes.deviation > 3.0).all()


@pytest.mark.parametrize("actors", ["ab", "abc", "abcdefgh"])
def test_rare_honest_numbers_far_outside_are_not_rejected_for_ever(actors: str) -> None:
    """A component that is 0, but for one row in 500."""
    votes, rejected = Votes(), list[int]()
    for turn in range(1200):
        found = votes.random.random((100, 1)) < 0.002
        votes.send(actors[turn % len(actors)], np.tile(1e7 * found, 2))
        rejected.append(len(votes.far))
    assert 0 < rejected[300] == rejected[-1]
    assert (votes.deviation > 1e5).all()


def test_restored_statistics_stand_in_for_the_votes() -> None:
    """After a resume the first rollout may be the bad one."""
    votes = Votes()
    votes.play("a", 100)
    votes.ranges = ConfirmedRanges()
    votes.send("a", votes.signs(9e14), is_honest=False)
    assert (votes.deviation < 1.5).all()


def test_old_values_fade() -> None:
    """A million values at 100, and as many of 1: the deviation between them is forgotten step by step."""
    moments = RunningMoments(())
    moments.mean.fill_(100.0)
    moments.count.fill_(1e6)
    moments.squares.fill_(1e6 * 1e4)
    for _ in range(1000):
        moments.merge(Moments(10_000, torch.tensor(1.0, dtype=torch.float64), torch.tensor(1e4, dtype=torch.float64)))
    assert moments.count == 1e6
    assert float(moments.mean) == pytest.approx(1.0, abs=0.1)
    assert float(moments.variance) == pytest.approx(1.0, abs=1.0)


def test_a_false_reward_does_not_reach_the_later_rollouts_of_the_episode() -> None:
    normalizer = RewardNormalizer(0.99)
    for turn in range(30):
        add(normalizer, [played(turn, 16 * turn, 1.0)])
    normalizer.moments_of([played(30, 480, 1e9)])
    assert float(normalizer.moments_of([played(31, 496, 1.0)]).mean) < 1e3
