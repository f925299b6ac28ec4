"""Every environment plays its share of whole episodes, whichever end first."""

import numpy as np

from actor.environments import make_environments
from actor.evaluation import play_episodes
from protocol.spec import EnvironmentSpec


class AlwaysZero:
    def load(self, weights: dict[str, np.ndarray]) -> None:
        pass

    def act(self, observations: np.ndarray, random: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        assert random is None
        return np.zeros(len(observations), np.int64), np.zeros(len(observations), np.float32)


def test_episodes_are_shared_out_and_counted_whole() -> None:
    """Episodes last 3, 2, 1, 3, ... steps in each environment; by hand: 0+1+2, 10+11, 20, 30+31+32."""
    environments = make_environments(EnvironmentSpec(id="counting_environment:Counting-v0"), 2)
    evaluation = play_episodes(AlwaysZero(), environments, 7, 1, sampled=False)
    # the first environment plays four, the second three
    assert sorted(evaluation.returns.tolist()) == [3, 3, 20, 20, 21, 21, 93]
    assert sorted(evaluation.lengths.tolist()) == [1, 1, 2, 2, 3, 3, 3]


def test_short_episodes_are_not_favoured() -> None:
    """Taking whichever end first would count more of the environment whose episodes are short."""
    environments = make_environments(EnvironmentSpec(id="CartPole-v1"), 50)
    few = play_episodes(AlwaysZero(), environments, 50, 1, sampled=False)
    many = play_episodes(AlwaysZero(), environments, 2000, 1, sampled=False)
    assert len(few.returns) == 50
    assert len(many.returns) == 2000
    assert abs(few.returns.mean() - many.returns.mean()) < 0.3
