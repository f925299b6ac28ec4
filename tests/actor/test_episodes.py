"""play_episodes: every environment plays its share of whole episodes."""

import os

import numpy as np
from allowed_modules import TEST_MODULES
from counting_environment import Counting

from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.episodes import environments_for, play_episodes
from daedalus.protocol.spec import EnvironmentSpec

COUNTING = EnvironmentSpec(id="counting_environment:Counting-v0")


class AlwaysZero:
    state_size = 0

    def load(self, weights: dict[str, np.ndarray]) -> None:
        pass

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: np.random.Generator | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        assert random is None
        return np.zeros(len(observations), np.int64), np.zeros(len(observations), np.float32), state


class Remembering(AlwaysZero):
    """A policy whose actions depend on every frame of the stack and on the memory."""

    state_size = 2

    def act(
        self, observations: np.ndarray, state: np.ndarray, random: np.random.Generator | None
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


def test_each_environment_plays_its_share_of_whole_episodes() -> None:
    """Episodes last 3, 2, 1, 3, ... steps in each environment; by hand: 0+1+2, 10+11, 20, 30+31+32."""
    environments = make_environments(COUNTING, 2, modules=TEST_MODULES)
    evaluation = play_episodes(AlwaysZero(), environments, 7, 1, sampled=False)
    # the first environment plays four, the second three
    assert sorted(evaluation.returns.tolist()) == [3, 3, 20, 20, 21, 21, 93]
    assert sorted(evaluation.lengths.tolist()) == [1, 1, 2, 2, 3, 3, 3]


def test_stacks_and_memory_equal_those_of_episodes_played_one_by_one() -> None:
    environments = make_environments(COUNTING.model_copy(update={"frame_stack": 4}), 3, modules=TEST_MODULES)
    evaluation = play_episodes(Remembering(), environments, 20, 1, sampled=False)
    expected = one_by_one(7) + one_by_one(7) + one_by_one(6)
    returns = [round(float(value), 3) for value in evaluation.returns]
    assert sorted(zip(returns, evaluation.lengths.tolist(), strict=True)) == sorted(expected)
    # The actions must differ for this test to mean anything: zeros alone would give whole numbers.
    assert len({round(value % 1, 1) for value in returns}) > 3


def test_short_episodes_are_not_favoured() -> None:
    """Counting whichever episodes end first would count more short ones."""
    environments = make_environments(EnvironmentSpec(id="CartPole-v1"), 50)
    few = play_episodes(AlwaysZero(), environments, 50, 1, sampled=False)
    many = play_episodes(AlwaysZero(), environments, 2000, 1, sampled=False)
    assert len(few.returns) == 50
    assert len(many.returns) == 2000
    assert abs(few.returns.mean() - many.returns.mean()) < 0.3


def test_progress_is_reported_after_every_step() -> None:
    reports: list[tuple[int, float]] = []
    environments = make_environments(COUNTING, 2, modules=TEST_MODULES)
    evaluation = play_episodes(
        AlwaysZero(),
        environments,
        3,
        1,
        sampled=False,
        progress=lambda finished, mean: reports.append((finished, mean)),
    )
    # Steps 1 to 3 end the first episode of both; then a reset row, and two steps to the end of the first's second.
    assert [finished for finished, _ in reports] == [0, 0, 2, 2, 2, 3]
    assert np.isnan([mean for _, mean in reports[:2]]).all()
    assert [mean for _, mean in reports[2:]] == [3, 3, 3, 9]
    assert evaluation.returns.tolist() == [3, 3, 21]


def test_environments_in_processes_are_limited_per_processor() -> None:
    processes = EnvironmentSpec(id="CarRacing-v3", processes=True)
    assert environments_for(7) == environments_for(7, COUNTING) == 7
    assert environments_for(1000, COUNTING) == 100
    assert environments_for(1000, processes) == 4 * (os.cpu_count() or 1)
    assert environments_for(2, processes) == 2
    assert environments_for(1000, processes.model_copy(update={"backend": "envpool"})) == 100
