"""actor/environments/minigrid_views.py: the same observations as MiniGrid's own, to the bit."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from daedalus.actor.environments.minigrid_views import speed_up

STEPS = 100


@pytest.fixture(autouse=True)
def _minigrid() -> None:
    """Import MiniGrid, which takes a sixth of a second, in the worker of these tests alone."""
    pytest.importorskip("minigrid")


def assert_same(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert list(ours) == list(theirs)
    np.testing.assert_array_equal(ours["image"], theirs["image"])
    assert (ours["image"].dtype, ours["image"].flags.writeable) == (np.uint8, True)
    assert (ours["direction"], ours["mission"]) == (theirs["direction"], theirs["mission"])


@pytest.mark.parametrize("kwargs", [{}, {"agent_view_size": 3}, {"agent_view_size": 9, "see_through_walls": True}])
@pytest.mark.parametrize(
    "name",
    [
        "MiniGrid-DoorKey-6x6-v0",  # locked doors, keys
        "MiniGrid-MultiRoom-N4-S5-v0",  # closed doors
        "MiniGrid-KeyCorridorS3R3-v0",
        "MiniGrid-Dynamic-Obstacles-8x8-v0",  # things that move by themselves
        "MiniGrid-MemoryS9-v0",
        "MiniGrid-ObstructedMaze-1Dlhb-v0",  # boxes with keys in them
        "MiniGrid-LavaCrossingS9N2-v0",
        "MiniGrid-FourRooms-v0",
        "BabyAI-UnlockPickupDist-v0",
    ],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_observations_are_those_of_minigrid(name: str, kwargs: dict[str, Any]) -> None:
    """Two environments with the same seeds and actions, of which one is as MiniGrid makes it."""
    made: Any = gymnasium.make(name, disable_env_checker=True).unwrapped
    other: Any = gymnasium.make(name, disable_env_checker=True).unwrapped
    for environment in (made, other):
        for key, value in kwargs.items():
            setattr(environment, key, value)  # the constructors of some do not take them
    assert speed_up(made)
    random, carried = np.random.default_rng(0), 0
    for seed in range(2):
        assert_same(made.reset(seed=seed)[0], other.reset(seed=seed)[0])
        for _ in range(STEPS):
            action = int(random.choice([0, 1, 2, 2, 2, 3, 4, 5, 5])) % made.action_space.n
            (ours, *result), (theirs, *expected) = made.step(action), other.step(action)
            assert_same(ours, theirs)
            assert result == expected
            carried += made.carrying is not None
            if result[1] or result[2]:
                break
    assert carried > 0 or "DoorKey" not in name


def test_what_is_not_minigrids_own_is_left_as_it_is() -> None:
    from minigrid.core.grid import Grid
    from minigrid.envs.doorkey import DoorKeyEnv
    from minigrid.minigrid_env import MiniGridEnv

    class OwnView(DoorKeyEnv):
        def gen_obs(self) -> dict[str, Any]:
            return {**super().gen_obs(), "image": np.zeros((7, 7, 3), np.uint8)}

    class OwnGrid(Grid):
        def slice(self, *place: Any, **named: Any) -> Grid:
            part = super().slice(*place, **named)
            part.grid = [None] * len(part.grid)
            return part

    assert not speed_up(OwnView())
    replaced = DoorKeyEnv()
    replaced.gen_obs = lambda: {}  # type: ignore[method-assign]
    assert not speed_up(replaced)
    assert not speed_up(gymnasium.make("CartPole-v1"))
    environment = DoorKeyEnv()
    assert speed_up(environment)
    environment.reset(seed=0)
    grid = environment.grid
    environment.grid = OwnGrid(grid.width, grid.height)
    environment.grid.grid = grid.grid
    np.testing.assert_array_equal(environment.gen_obs()["image"], MiniGridEnv.gen_obs(environment)["image"])
    assert environment.gen_obs()["image"][..., 0].max() == 1  # all empty
