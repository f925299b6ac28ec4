"""learner/reporting/hints.py: a run that does not learn says so, once."""

from typing import Any

import numpy as np
import pytest
from building import make_rollout

from daedalus.learner.reporting.hints import LearningHint, ObservationHint
from daedalus.protocol.spec import TrainingSpec


def row(
    share: float, returned: float, entropy: float, explained: float = 0.5, episodes: float = 20
) -> dict[str, float]:
    return {
        "env_steps": share * 1000,
        "episodes": episodes,
        "episode_return_mean": returned,
        "episode_return_std": 2.0,
        "episode_return_min": returned - 3.0,
        "episode_return_max": returned + 3.0,
        "entropy": entropy,
        "explained_variance": explained,
    }


def hints(*rows: dict[str, float], **training: Any) -> list[str]:
    hint, taken = LearningHint(TrainingSpec(env_steps=1000, **training)), []
    for each in rows:
        hint.add(each)
        taken.append(hint.take())
    return taken


def test_run_with_a_collapsed_entropy_and_the_first_return_gets_one_hint() -> None:
    first, second, third = hints(row(0.01, -200.0, 1.4), row(0.2, -199.6, 0.1), row(0.3, -200.0, 0.1))
    assert (first, third) == ("", "")
    assert second.startswith("this run does not learn: after a fifth of the budget the mean return is -199.6, and w")
    assert "the entropy fell from 1.4 to 0.1" in second
    assert "training.entropy_bonus" in second


@pytest.mark.parametrize(
    "last",
    [
        row(0.2, -199.0, 0.1),  # it became better
        row(0.2, -200.0, 0.2),  # it still explores
        row(0.19, -200.0, 0.1),  # too early
    ],
)
def test_run_that_learns_or_explores_gets_no_hint(last: dict[str, float]) -> None:
    assert hints(row(0.01, -200.0, 1.4), last) == ["", ""]


def test_game_with_opponents_whose_mean_return_is_0_by_construction_gets_no_hint() -> None:
    rows = [row(share, 0.0, entropy) for share, entropy in ((0.01, 1.4), (0.1, 0.1), (0.2, 0.1), (0.3, 0.1))]
    assert hints(*rows)[2] != ""
    assert set(hints(*({**each, "rating": 100.0} for each in rows))) == {""}


def test_run_whose_return_rises_gets_no_hint_whatever_its_critic_explains() -> None:
    rising = [row(0.1 + 0.02 * index, 5.9 + 2.0 * index, 1.0, -0.1) for index in range(6)]
    assert set(hints(row(0.01, 5.9, 1.0, -5.0), *rising)) == {""}
    evaluated = [row(0.1 + 0.02 * index, 5.9, 1.0, -0.1) for index in range(6)]  # where actors explore
    for index, mean in ((0, 5.0), (2, 5.0), (4, 15.5)):
        evaluated[index] |= {"evaluation_return_mean": mean, "evaluation_return_std": 1.0}
    assert set(hints(row(0.01, 5.9, 1.0, -5.0), *evaluated)) == {""}
    evaluated[4]["evaluation_return_mean"] = 5.0
    assert hints(row(0.01, 5.9, 1.0, -5.0), *evaluated)[-1].startswith(
        "this run does not learn: after a fifth of the budget the mean return is 5.9, and was 5.9 at the start, and"
    )


def test_run_whose_critic_explains_nothing_gets_a_hint() -> None:
    watched = [row(0.1 + 0.02 * index, 0.0, 1.0, -0.1) for index in range(6)]
    *before, last = hints(row(0.01, 0.0, 1.0, -5.0), *watched)
    assert set(before) == {""}
    assert "the value explains nothing of the returns; try training.normalize_rewards=true" in last
    normalizing = hints(row(0.01, 0.0, 1.0, -5.0), *watched, normalize_rewards=True)[-1]
    assert normalizing.endswith("explains nothing of the returns; try a smaller training.learning_rate")
    constant = [row(0.1 + 0.02 * index, 0.0, 1.0, 6e-8) for index in range(6)]  # as of a network whose units are dead
    assert "explains nothing" in hints(row(0.01, 0.0, 1.0), *constant)[-1]
    watched[3]["explained_variance"] = 0.1
    assert set(hints(row(0.01, 0.0, 1.0), *watched)) == {""}


def equal(share: float, entropy: float = 1.0) -> dict[str, float]:
    returns = {"episode_return_std": 0.0, "episode_return_min": -200.0, "episode_return_max": -200.0}
    return {**row(share, -200.0, entropy, -1e5), **returns}


@pytest.mark.parametrize("entropy", [1.0, 0.01])
def test_run_whose_returns_are_all_equal_gets_a_hint_of_its_own(entropy: float) -> None:
    watched = [equal(0.1 + 0.02 * index, entropy) for index in range(6)]
    *before, last = hints(equal(0.01), *watched)
    assert set(before) == {""}
    assert last.startswith("this run has nothing to learn from: every episode so far has the return -200, so")
    assert last.endswith("reach the goal; training.curiosity=1 explores more, where observations come back")
    assert hints(equal(0.01), *watched, curiosity=0.5)[-1].endswith("whether random actions can reach the goal")
    watched[2]["episode_return_max"] = -199.0
    assert "every episode" not in hints(equal(0.01), *watched)[-1]


def test_rows_without_returns_are_no_reason_for_a_hint_and_delay_it() -> None:
    """Before the first episode, and after a target that new episodes did not confirm, there are no newest returns."""
    without = {name: value for name, value in row(0.2, 0.0, 0.1).items() if not name.startswith("episode_return")}
    first, second, third = hints(row(0.01, -200.0, 1.4), without, row(0.21, -200.0, 0.1))
    assert (first, second) == ("", "")
    assert "the entropy fell from 1.4 to 0.1" in third


def test_run_is_not_judged_without_its_first_episodes() -> None:
    assert hints(row(0.06, -200.0, 1.4), row(0.2, -200.0, 0.1)) == ["", ""]  # resumed, or very long episodes
    assert hints(row(0.01, -200.0, 1.4, episodes=19), row(0.2, -200.0, 0.1, episodes=19)) == ["", ""]


@pytest.mark.parametrize("changes", ["nothing", "episodes", "first frame of a stack", "rows"])
def test_observations_that_stand_still_get_a_hint_once(changes: str) -> None:
    """A picture that changes from episode to episode, and in frames that no row has as its newest, stands still."""
    hint, given = ObservationHint(), []
    for number in range(6):
        rollout = make_rollout(rows=128, environments=8, stack=4, seed=number)
        frames = np.zeros_like(rollout.frames["observation"])
        if changes == "episodes":
            frames[3:] = 1.0 + np.concatenate([np.zeros((1, 8)), np.cumsum(~rollout.valid, 0)])[..., None]
        elif changes == "first frame of a stack":
            frames[0] = 1.0
        elif changes == "rows" and number == 3:
            frames[60:] = 1.0
        hint.look([make_rollout(rows=128, environments=8, stack=4, seed=number, frames=frames)])
        given.append(hint.take())
    assert [bool(text) for text in given] == [False, False, False, changes != "rows", False, False]
    if changes != "rows":
        assert given[3].startswith("the observation has changed in none of 2,")
