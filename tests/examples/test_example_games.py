"""The games in examples/: `daedalus check` accepts them, both sides are alike, and the better player wins."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daedalus.actor.checking.play import check_environment
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import EnvironmentSpec

SIDES = ("left", "right")


@pytest.fixture(autouse=True)
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))


@pytest.mark.parametrize("game", ["duel:Duel", "rock_paper_scissors:RockPaperScissors"])
def test_check_finds_no_problem(game: str) -> None:
    modules = UserModules(frozenset({game.partition(":")[0]}))
    spec = EnvironmentSpec(id=game, backend="pettingzoo")
    report = check_environment(spec, modules, seconds=60.0, env_steps=1_000, seed=1)
    assert (report.problems, report.warnings, report.seats, report.env_steps) == ((), (), 2, 1_000)


def test_each_choice_beats_the_one_before_it() -> None:
    from rock_paper_scissors import RockPaperScissors  # pyright: ignore[reportMissingImports]

    game, results = RockPaperScissors(), []
    for actions in np.ndindex(3, 3):
        game.reset()
        results.append(game.step(dict(zip(SIDES, actions, strict=True)))[1]["left"])
    assert results == [0, -1, 1, 1, 0, -1, -1, 1, 0]


def follow(seen: np.ndarray) -> int:
    """Return the action towards the height of the ball."""
    return 1 + int(np.sign(round(float(seen[3] - seen[0]) / 0.1)))


@pytest.mark.parametrize("better", SIDES)
def test_player_that_follows_the_ball_wins_a_duel_against_one_that_stays(better: str) -> None:
    from duel import POINTS, Duel  # pyright: ignore[reportMissingImports]

    game: Any = Duel()
    seen, _ = game.reset(seed=5)
    over = cut = dict[str, bool]()
    points: dict[str, float] = dict.fromkeys(SIDES, 0.0)
    while game.agents:
        assert np.array_equal(seen["left"] * (1, 1, -1, 1, -1, 1), seen["right"][[1, 0, 2, 3, 4, 5]])
        seen, rewards, over, cut, _ = game.step({side: follow(seen[side]) if side == better else 1 for side in SIDES})
        points = {side: points[side] + rewards[side] for side in SIDES}
    assert over == {"left": True, "right": True}
    assert cut == {"left": False, "right": False}
    assert points[better] == -points[SIDES[better == "left"]] > 0.0
    assert max(game.points) == POINTS
