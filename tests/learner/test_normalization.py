"""algorithms/normalization.py, running_returns.py: statistics equal those of all values, however they arrive."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from building import POLICY, identity, join, make_rollout
from plain import NAME, plain

from daedalus.algorithms import normalization, running_returns
from daedalus.algorithms.normalization import ObservationStatistics, RewardNormalizer, RunningMoments, moments_of
from daedalus.algorithms.running_returns import RunningReturns
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.normalization import ObservationNormalizer
from daedalus.policy.normalized import normalized_components
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
    assert moments.count == 100
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
        normalizer.add(rollouts[start : start + size])
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
    normalizer.add([sent(0)])
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
        normalizer.add([played(2 * turn, 16 * turn, 1.0, stack=stack)])
        normalizer.add([played(2 * turn + 1, 10_000 + 16 * turn, -1.0, stack=stack)])
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
        normalizer.add([rollout])
    expected = (1.0 - 0.9 ** np.arange(1, 100 * rows + 1)) / 0.1
    assert float(normalizer.moments.mean) == pytest.approx(expected.mean(), rel=1e-6)


def test_returns_run_on_over_rows_that_a_client_does_not_send() -> None:
    """As in runs of a2c, while the client waits for the next policy."""
    normalizer = RewardNormalizer(0.5, synchronous=True)
    normalizer.add([played(0, 0, 1.0), played(1, 100, 1.0)])
    expected = (1.0 - 0.5 ** np.arange(1, 33)) / 0.5
    assert float(normalizer.moments.mean) == pytest.approx(expected.mean(), rel=1e-6)


def test_running_returns_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running_returns, "_MAX_STREAMS", 2)
    returns = RunningReturns(DISCOUNT)
    for rollout in [sent(0, actor) for actor in "abc"]:
        returns.add(rollout)
    assert [stream.actor for stream in returns._running] == ["b", "c"]
    returns.add(sent(1, "b"))
    assert [stream.actor for stream in returns._running] == ["c", "b"]


def test_observations_of_valid_rows_are_counted_once_in_each_component() -> None:
    spaces = {
        NAME: ArraySpace(shape=(3,), dtype="float32"),
        "bytes": ArraySpace(shape=(2,), dtype="uint8"),
        "image": ArraySpace(shape=(16, 16), dtype="uint8"),
        "choice": DiscreteSpace(counts=(3,)),
    }
    normalizer = ObservationNormalizer(normalized_components(PolicySpec(normalize_observations=True), spaces))
    assert normalizer.names == (NAME, "bytes")
    statistics = ObservationStatistics(normalizer)
    random, seen = np.random.default_rng(2), {NAME: [], "bytes": []}
    for seed in range(3):
        rollout = make_rollout(seed=seed)
        more = {
            "bytes": random.integers(0, 256, (7, 3, 2), np.uint8),
            "image": random.integers(0, 256, (7, 3, 16, 16), np.uint8),
            "choice": random.integers(0, 3, (7, 3, 1), np.uint8),
        }
        rollout = replace(rollout, frames={NAME: plain(rollout.frames), **more})
        statistics.add(join([rollout], Spaces(observations=spaces, actions=ACTIONS)))
        for name, values in seen.items():
            values.append(rollout.frames[name][:-1][rollout.valid])
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
    statistics = ObservationStatistics(network.normalizer)
    statistics.take_from_network()
    statistics.add(join([make_rollout()]))
    mean, variance = network.normalizer.statistics(NAME)
    assert ((mean - 50.0).abs() < 0.1).all()
    assert ((variance - 4.0).abs() < 0.5).all()
