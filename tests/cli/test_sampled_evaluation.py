"""cli/sampled_evaluation.py: when sampled episodes are played, and what is said of them."""

from typing import Any

import pytest

from daedalus.launch.final_evaluation import is_below_training, sampled_note


def result(mean: float, std: float, actions: str = "greedy", episodes: int = 100) -> dict[str, Any]:
    return {"return_mean": mean, "return_std": std, "actions": actions, "episodes": episodes}


@pytest.mark.parametrize(
    ("evaluation", "training_mean", "below"),
    [
        (result(0.0, 0.0), 0.9, True),
        (result(180.0, 100.0), 200.0, False),  # a standard error of 10
        (result(160.0, 100.0), 200.0, True),
        (result(160.0, 100.0, episodes=16), 200.0, False),
        (result(0.0, 0.0, episodes=9), 200.0, False),
        (result(250.0, 1.0), 200.0, False),
        (result(0.0, 0.0, "sampled"), 0.9, False),
        (result(0.0, 0.0), None, False),
    ],
)
def test_greedy_episodes_are_compared_with_training(
    evaluation: dict[str, Any], training_mean: float | None, below: bool
) -> None:
    assert is_below_training(evaluation, training_mean) == below


def test_sampled_actions_are_recommended_only_if_they_are_better() -> None:
    better = sampled_note(result(0.0, 0.0), result(0.9, 0.1, "sampled"))
    assert better.startswith("sampled actions: return 0.9 +- 0.1 over 100 episodes")
    assert better.endswith("--actions sampled (evaluation.actions)")
    assert "--actions" not in sampled_note(result(160.0, 100.0), result(170.0, 100.0, "sampled"))
