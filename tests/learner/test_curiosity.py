"""algorithms/curiosity.py: what is new in an episode, and the reward for it, as a slow oracle says."""

from dataclasses import replace

import numpy as np
import pytest
from building import POLICY, SPACES, identity, make_rollout, run_spec

from daedalus.algorithms import curiosity
from daedalus.algorithms.curiosity import FirstVisits
from daedalus.learner.training.learner import Learner
from daedalus.protocol.spec import RunSpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

DISCOUNT = 0.9


def walk(seed: int, batches: int = 4, *, stack: int = 1) -> list[list[Rollout]]:
    """Return batches of one rollout of each of two actors, which continue those before: few different observations."""
    random, played = np.random.default_rng(seed), list[list[Rollout]]()
    for batch in range(batches):
        rollouts = []
        for actor in "ab":
            rollout = make_rollout(identity(actor, batch), seed=int(random.integers(1000)), stack=stack)
            frames = random.integers(0, 3, rollout.frames["observation"].shape).astype(np.float32)
            frames[..., 1:] = 0.0
            valid = rollout.valid
            if batch:
                before = next(each for each in played[-1] if each.identity.actor == actor)
                frames[:stack] = before.frames["observation"][-stack:]
                valid = valid.copy()
                valid[0] = ~(before.terminated[-1] | before.truncated[-1])
            rollouts.append(replace(rollout, frames={"observation": frames}, valid=valid))
        played.append(rollouts)
    return played


def first_visits(played: list[list[Rollout]]) -> dict[Rollout, np.ndarray]:
    """Return 1 for each row t for which s_{t+1} is none of the observations of its episode until s_t, else 0."""
    result = {}
    for index in (0, 1):
        rollouts = [batch[index] for batch in played]
        newest = np.concatenate([each.frames["observation"][-each.rows - 1 : -1] for each in rollouts])
        newest = np.concatenate([newest, rollouts[-1].frames["observation"][-1:]])  # [rows of all + 1, E, D]
        valid = np.concatenate([each.valid for each in rollouts])
        found = np.zeros(valid.shape, np.float32)
        for t, e in np.argwhere(valid):
            begin = max((k + 1 for k in range(t) if not valid[k, e]), default=0)
            found[t, e] = all((newest[k, e] != newest[t + 1, e]).any() for k in range(begin, t + 1))
        result |= dict(zip(rollouts, np.split(found, len(rollouts)), strict=True))
    return result


@pytest.mark.parametrize("stack", [1, 3])
def test_first_visits_are_those_of_whole_episodes(stack: int) -> None:
    played = walk(3, stack=stack)
    expected, visits = first_visits(played), FirstVisits()
    for each in [rollout for batch in played for rollout in batch]:
        np.testing.assert_array_equal(visits.add(each), expected[each])
    rows = np.concatenate([found[each.valid] for each, found in expected.items()])
    assert 0.2 < rows.mean() < 0.8


def test_by_hand() -> None:
    """One environment, observations by number: 0 1 0 2 | 2 0 (a reset row between the episodes)."""
    numbers, valid = [0, 1, 0, 2, 2, 0, 0], [True, True, True, False, True, True]
    ends = np.array([[False], [False], [True], [False], [False], [False]])
    rollout = make_rollout(
        environments=1,
        frames=np.array(numbers, np.float32)[:, None, None].repeat(3, 2),
        valid=np.array(valid)[:, None],
        terminated=ends,
        truncated=np.zeros_like(ends),
        episode_returns=np.zeros(1, np.float32),
        episode_lengths=np.ones(1, np.int32),
    )
    assert FirstVisits().add(rollout)[:, 0].tolist() == [1, 0, 1, 0, 1, 0]


@pytest.mark.parametrize("algorithm", ["a2c", "appo", "n_step_q"])
def test_update_equals_that_of_rewards_with_the_bonus(algorithm: str) -> None:
    """b = w / d, where d is the deviation of the discounted sums of first visits so far, or a fifth of their mean."""
    settings = {"algorithm": algorithm, "discount_factor": DISCOUNT, "passes": 1, "minibatches": 1}
    curious, plain = (
        Learner(TrainingSpec.model_validate({**settings, "curiosity": weight}), POLICY, SPACES) for weight in (2.0, 0.0)
    )
    played = walk(5)
    first, sums = first_visits(played), dict[str, np.ndarray]()
    seen: list[float] = []
    for number, batch in enumerate(played):
        for each in batch:
            running = sums.get(each.identity.actor, np.zeros(each.environments))
            for t in range(each.rows):
                running = first[each][t] + DISCOUNT * running
                seen += running[each.valid[t]].tolist()
                running = np.where(each.terminated[t] | each.truncated[t], 0.0, running)
            sums[each.identity.actor] = running
        divisor, progress = max(np.std(seen), np.mean(seen) / 5.0), number / 10
        bonus = {each: np.float32(2.0 * (1.0 - progress) / divisor) * first[each] for each in batch}
        curious.step(batch, progress)
        plain.step([replace(each, rewards=each.rewards + bonus[each]) for each in batch], progress)
        for name, values in plain.weights().items():
            np.testing.assert_allclose(curious.weights()[name], values, atol=1e-4)
        if algorithm == "appo":
            taken = curious.take_diagnostics()
            learned = np.concatenate([bonus[each][each.valid] for each in batch])
            assert taken["curiosity_reward_mean"] == pytest.approx(learned.mean(), rel=1e-3)
            assert taken["first_visit_fraction"] == pytest.approx((learned > 0.0).mean())
    assert "curiosity_reward_mean" not in plain.take_diagnostics()


def test_run_may_become_curious_at_a_resume() -> None:
    plain = Learner(TrainingSpec(), POLICY, SPACES)
    curious = Learner(TrainingSpec(curiosity=1.0), POLICY, SPACES)
    curious.restore(3, plain.weights(), plain.state())
    assert curious.policy_version == 3
    plain.restore(4, curious.weights(), curious.state())


def test_curiosity_stops_and_says_so_where_observations_do_not_come_back(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(curiosity, "_JUDGED_ROWS", 50)  # as few as there are here
    learner = Learner(TrainingSpec(algorithm="appo", curiosity=1.0), POLICY, SPACES)
    for batch in walk(1, 8):
        learner.step(batch, 0.0)
    assert not caplog.records
    assert learner.take_diagnostics()["curiosity_reward_mean"] > 0.0
    learner = Learner(TrainingSpec(algorithm="appo", curiosity=1.0), POLICY, SPACES)
    rewarded = []
    for number in range(8):
        learner.step([make_rollout(identity(sequence=number), seed=number)], 0.0)
        rewarded.append(learner.take_diagnostics()["curiosity_reward_mean"] > 0.0)
    assert rewarded[0]
    assert rewarded == sorted(rewarded, reverse=True)
    assert not rewarded[-1]
    assert [record.getMessage()[:34] for record in caplog.records] == ["training.curiosity stops: 100 % of"]


@pytest.mark.parametrize("other", [0, 1, 4])
def test_reward_fades_where_all_episodes_have_equally_many_observations(other: int) -> None:
    """Episodes of one step in eight environments. In `other` of them, the first one ends where it began."""
    environments = 8
    numbers = np.tile(np.array([0, 1, 0, 1, 0, 1, 0], np.float32)[:, None], (1, environments))
    numbers[1, :other] = 0.0
    valid = np.tile(np.array([True, False] * 3)[:, None], (1, environments))
    rollout = make_rollout(
        environments=environments,
        frames=numbers[..., None].repeat(3, 2),
        valid=valid,
        terminated=valid,
        truncated=np.zeros_like(valid),
        episode_returns=np.zeros(3 * environments, np.float32),
        episode_lengths=np.ones(3 * environments, np.int32),
    )
    curious = curiosity.Curiosity(DISCOUNT)
    curious.look([rollout], 1.0)
    first = [1.0] * (24 - other) + [0.0] * other
    divisor = max(np.std(first), np.mean(first) / 5.0)
    expected = np.mean(first) / divisor * min(4.0 * np.std(first), 1.0)
    assert curious.metrics()["curiosity_reward_mean"] == pytest.approx(expected)
    assert bool(expected) == bool(other)


def test_reward_shrinks_while_the_mean_return_is_below_its_best() -> None:
    """The first 100 episodes have the mean 1 and the deviation 2: 0.5 less halves the reward, 1 less ends it."""

    def rollout(*returns: float) -> Rollout:
        lengths = np.ones(len(returns), np.int32)
        return make_rollout(environments=20, rows=20, episode_returns=np.array(returns), episode_lengths=lengths)

    curious, resumed = curiosity.Curiosity(DISCOUNT), curiosity.Curiosity(DISCOUNT)

    def factor(*returns: float, of: curiosity.Curiosity = curious) -> float:
        of.look([rollout(*returns)], 1.0)
        metrics = of.metrics()
        return metrics["curiosity_reward_mean"] / metrics["first_visit_fraction"]

    at_first = factor(-1.0, 3.0)  # too few episodes
    assert factor(*[-1.0] * 49, *[3.0] * 49) == pytest.approx(at_first, rel=0.1)
    assert factor(*[0.5] * 100) == pytest.approx(0.5 * at_first, rel=0.1)
    assert factor(*[0.0] * 100) == factor(*[-9.0] * 100) == 0.0
    assert factor(*[1.0] * 50) == 0.0  # with 50 that had -9
    assert factor(*[1.0] * 50) == pytest.approx(at_first, rel=0.1)
    assert factor(*[2.0] * 100) > 0.0  # a new best
    for name, values in resumed.statistics.items():
        values.copy_(curious.statistics[name])
    assert factor(*[2.0] * 100, of=resumed) > 0.0
    assert factor(*[1.0] * 100, of=resumed) == 0.0


def test_curiosity_refuses_gradients_of_actors() -> None:
    content = run_spec(algorithm="a3c", curiosity=1.0).model_dump()
    content["collection"]["upload"] = "gradients"
    with pytest.raises(ValueError, match=r"training.curiosity needs rollouts.*set collection.upload=rollouts"):
        RunSpec.model_validate(content)
