"""play_episodes: whole episodes in rounds, one in each environment."""

import re
from typing import Any

import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from counting_environment import Counting
from plain import PlainPolicy

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.vector_environments import VectorEnvironment
from daedalus.actor.evaluation.episodes import environments_for, play_episodes
from daedalus.policy.acting.noise import Noise
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import CollectionSpec, EnvironmentSpec
from daedalus.transport.process_usage import available_processors

COUNTING = EnvironmentSpec(id="counting_environment:Counting-v0")


class AlwaysZero(PlainPolicy):
    """A policy that is asked for greedy actions."""

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        assert (noise.uniform == 0.5).all()
        assert (noise.normal == 0.0).all()
        return super().choose(observations, state, noise)


class Remembering(AlwaysZero):
    """A policy whose actions depend on every frame of the stack and on the memory."""

    state_size = 2

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        chosen = [one_action(stack, memory) for stack, memory in zip(observations, state, strict=True)]
        actions, memories = zip(*chosen, strict=True)
        return np.array(actions), np.zeros(len(actions), np.float32), np.array(memories, np.float32)


def one_action(stack: np.ndarray, memory: np.ndarray) -> tuple[int, list[float]]:
    """The action for a stack [4, 2] and a memory [2], and the memory after it."""
    shown = stack @ [3, 1] @ [1, 2, 3, 5]
    return int(shown + 7 * memory[0] + memory[1]) % 4, [memory[0] + 1, (memory[1] + shown) % 64]


def one_by_one(episodes: int) -> list[tuple[float, int]]:
    """The returns and lengths of the first episodes of one environment, as `Remembering` plays them."""
    environment = Counting()
    played = []
    for _ in range(episodes):
        frame, _ = environment.reset()
        seen, memory, total, over = [frame] * 4, np.zeros(2), 0.0, False
        while not over:
            action, remembered = one_action(np.stack(seen[-4:]), memory)
            memory = np.array(remembered)
            frame, reward, terminated, truncated, _ = environment.step(np.int64(action))
            seen.append(frame)
            total += reward
            over = terminated or truncated
        played.append((round(total, 3), len(seen) - 4))
    return played


def counting(count: int, **fields: Any) -> VectorEnvironment:
    return make_environments(COUNTING.model_copy(update=fields), count, modules=TEST_MODULES, one_episode=True)


def test_each_environment_plays_one_episode_of_each_round() -> None:
    """Episodes last 3, 2, 1, 3, ... steps in each environment; by hand: 0+1+2, 10+11, 20, 30+31+32."""
    evaluation = play_episodes(AlwaysZero(), counting(2), 7, 1, sampled=False)
    assert evaluation.returns.tolist() == [3, 3, 21, 21, 20, 20, 93]
    assert evaluation.lengths.tolist() == [3, 3, 2, 2, 1, 1, 3]


def test_stacks_and_memory_equal_those_of_episodes_played_one_by_one() -> None:
    evaluation = play_episodes(Remembering(), counting(3, frame_stack=4), 20, 1, sampled=False)
    expected = [episode for episode in one_by_one(7) for _ in range(3)][:20]
    returns = [round(float(value), 3) for value in evaluation.returns]
    assert list(zip(returns, evaluation.lengths.tolist(), strict=True)) == expected
    # The actions must differ for this test to mean anything: zeros alone would give whole numbers.
    assert len({round(value % 1, 1) for value in returns}) > 3


def test_short_episodes_are_not_favoured() -> None:
    """Counting whichever episodes end first would count more short ones."""
    environments = make_environments(EnvironmentSpec(id="CartPole-v1"), 50, one_episode=True)
    few = play_episodes(AlwaysZero(), environments, 50, 1, sampled=False)
    many = play_episodes(AlwaysZero(), environments, 2000, 1, sampled=False)
    assert len(few.returns) == 50
    assert len(many.returns) == 2000
    assert abs(few.returns.mean() - many.returns.mean()) < 0.3


def test_progress_is_reported_after_every_step() -> None:
    reports: list[tuple[int, float]] = []
    evaluation = play_episodes(
        AlwaysZero(),
        counting(2),
        3,
        1,
        sampled=False,
        progress=lambda finished, mean: bool(reports.append((finished, mean))),
    )
    # Steps 1 to 3 end the first episode of both; two more end the second episode of the first.
    assert [finished for finished, _ in reports] == [0, 0, 2, 2, 3]
    assert np.isnan([mean for _, mean in reports[:2]]).all()
    assert [mean for _, mean in reports[2:]] == [3, 3, 9]
    assert evaluation.returns.tolist() == [3, 3, 21]


def test_episodes_that_do_not_end_are_cut_and_the_next_round_begins() -> None:
    """By hand: 0+1+2 and 10+11 end; without a cut the third episode would last 100 steps."""
    environments = counting(1, kwargs={"ends": [3, -2, 100]})
    evaluation = play_episodes(AlwaysZero(), environments, 4, 1, sampled=False, longest=4)
    assert evaluation.returns.tolist() == [3, 21, 20 + 21 + 22 + 23, 93]
    assert evaluation.lengths.tolist() == [3, 2, 4, 3]
    assert evaluation.cut.tolist() == [False, False, True, False]


def test_an_episode_that_ends_with_its_last_step_is_not_cut() -> None:
    evaluation = play_episodes(AlwaysZero(), counting(2), 3, 1, sampled=False, longest=3)
    assert evaluation.cut.tolist() == [False] * 3


def test_progress_may_end_the_evaluation() -> None:
    """The episodes that began are counted, with the part that was played."""
    steps = iter([False, False, False, True])
    evaluation = play_episodes(AlwaysZero(), counting(2), 6, 1, sampled=False, progress=lambda *_: next(steps))
    assert evaluation.returns.tolist() == [3, 3, 10, 10]
    assert evaluation.lengths.tolist() == [3, 3, 1, 1]
    assert evaluation.cut.tolist() == [False, False, True, True]


def test_a_reward_that_is_not_finite_ends_the_evaluation() -> None:
    spec = EnvironmentSpec(id="faulty_environments:Faulty-v0", kwargs={"fault": "reward"})
    modules = UserModules(frozenset({"faulty_environments"}))
    environments = make_environments(spec, 2, modules=modules, one_episode=True)
    with pytest.raises(EnvironmentSetupError, match="gave the reward nan in episode 1 of the evaluation"):
        play_episodes(AlwaysZero(), environments, 2, 1, sampled=False)


SHOWING = UserModules(frozenset({"showing_environments"}))


def showing(shown: list[Any], name: str = "Showing-v0", **kwargs: Any) -> EnvironmentSpec:
    return EnvironmentSpec(id=f"showing_environments:{name}", kwargs={"shown": shown, **kwargs})


@pytest.mark.parametrize("name", ["Showing-v0", "ShowingVector-v0"])
@pytest.mark.parametrize(
    ("shown", "kwargs", "reason"),
    [
        ([0, "nan", 0, 0], {}, "component 'observation' has a value that is not finite (nan), in environment 0"),
        (["-inf", 0, 0], {}, "has a value that is not finite (-inf)"),
        ([0, 1e300, 0], {"space": "float64"}, "has a value that is not finite (inf)"),
        ([0, 1e16, 0], {"space": "float64"}, "beyond +-1e+15: scale or clip the observations (it is 1e+16)"),
        ([0, 300, 0], {"space": "int8", "dtype": "int64"}, "has the value 300, but its space has dtype int8"),
        ([0, -1, 0], {"space": "uint8", "dtype": "int64"}, "dtype"),
        ([0, 0, 0], {"rewards": [0, "inf", 0]}, "the reward inf in episode 1"),
        ([0, 0, 0], {"rewards": [0, 1e300, 0]}, "the reward 1e+300 in episode 1"),
        ([0, 0, 0, 0], {"rewards": [0, 3e38, 3e38, 0]}, "the return of episode 1 of the evaluation is 6e+38"),
    ],
)
def test_evaluation_refuses_numbers_that_training_refuses(
    name: str, shown: list[Any], kwargs: dict[str, Any], reason: str
) -> None:
    environments = make_environments(showing(shown, name, **kwargs), 1, modules=SHOWING, one_episode=True)
    with pytest.raises(EnvironmentSetupError, match=re.escape(reason)):
        play_episodes(AlwaysZero(), environments, 1, 1, sampled=False)


def test_nobody_acts_on_the_last_observation_of_an_episode() -> None:
    environments = make_environments(showing([0, 0, "nan"]), 2, modules=SHOWING, one_episode=True)
    assert play_episodes(AlwaysZero(), environments, 3, 1, sampled=False).lengths.tolist() == [2, 2, 2]


def test_environments_in_processes_are_limited_per_processor() -> None:
    processes, many = EnvironmentSpec(id="CarRacing-v3", processes=True), CollectionSpec(actors=64, envs_per_actor=64)
    assert environments_for(7, COUNTING, many) == 7
    assert environments_for(1000, COUNTING, many) == 100
    assert environments_for(1000, processes, many) == 4 * available_processors()
    assert environments_for(2, processes, many) == 2
    assert environments_for(1000, processes.model_copy(update={"backend": "envpool"}), many) == 100


def test_evaluation_has_no_more_environments_than_training() -> None:
    few = CollectionSpec(actors=2, envs_per_actor=3)
    assert environments_for(1000, COUNTING, few) == 6
    assert environments_for(1000, EnvironmentSpec(id="A-v0", processes=True), few) == min(6, 4 * available_processors())
