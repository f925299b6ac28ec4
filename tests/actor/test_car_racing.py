"""CarRacing rendered on demand and by the fast renderer, compared with gymnasium's own."""

import itertools
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from gymnasium.envs.box2d.car_dynamics import Car
from gymnasium.envs.box2d.car_racing import PLAYFIELD
from plain import PlainEnvironments

from daedalus.actor.checking.checker import gymnasium_notes
from daedalus.actor.environments.car_racing import FastCarRacing, LateRenderedCarRacing
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import EnvironmentFactory
from daedalus.actor.environments.make import make_environments
from daedalus.protocol.spec import EnvironmentSpec

TABLE = ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.8), (-0.4, 0.3, 0.0), (0.4, 0.3, 0.0))
ROAD = slice(0, 84)  # the pixel rows above the dashboard


def _spec(**fields) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate({"id": "CarRacing-v3", "action_table": TABLE, "action_repeat": 4, **fields})


def _original(seed: int, actions: list[int], limit: int) -> list[tuple]:
    """(frame, reward, terminated, truncated) of gymnasium.make's own, each action repeated four times."""
    environment = gymnasium.make("CarRacing-v3", max_episode_steps=limit)
    frame, _ = environment.reset(seed=seed)
    rows = [(frame, 0.0, False, False)]
    for action in actions:
        total, repeats = 0.0, 0
        terminated = truncated = False
        while repeats < 4 and not (terminated or truncated):
            frame, reward, terminated, truncated, _ = environment.step(np.array(TABLE[action], np.float32))
            total, repeats = total + float(reward), repeats + 1
        rows.append((frame, total, terminated, truncated))
    environment.close()
    return rows


def _ours(backend: str, seed: int, actions: list[int], limit: int) -> list[tuple]:
    with closing(
        PlainEnvironments(make_environments(_spec(backend=backend, max_episode_steps=limit), 1))
    ) as environments:
        rows = [(environments.reset(seed)[0], 0.0, False, False)]
        for action in actions:
            frames, rewards, terminated, truncated = environments.step(np.array([action]))
            rows.append((frames[0].copy(), float(rewards[0]), bool(terminated[0]), bool(truncated[0])))
        return rows


@pytest.fixture(scope="module")
def drive() -> tuple[int, list[int], int]:
    """A seed, the actions of a drive with turns that leaves the road, and the limit that ends it."""
    actions = np.random.default_rng(5).choice(5, size=60, p=(0.1, 0.4, 0.05, 0.3, 0.15)).tolist()
    return 11, actions, 240


@pytest.fixture(scope="module")
def original(drive: tuple[int, list[int], int]) -> list[tuple]:
    return _original(*drive)


def test_late_rendering_gives_the_same_episodes_and_frames(
    drive: tuple[int, list[int], int], original: list[tuple]
) -> None:
    ours = _ours("gymnasium", *drive)
    assert [row[1:] for row in ours] == [row[1:] for row in original]
    assert original[-1][3]
    for one, other in zip(ours, original, strict=True):
        np.testing.assert_array_equal(one[0], other[0])


def test_fast_renderer_gives_the_same_episodes_and_similar_frames(
    drive: tuple[int, list[int], int], original: list[tuple]
) -> None:
    ours = _ours("fast", *drive)
    assert [row[1:] for row in ours] == [row[1:] for row in original]
    different = [np.abs(one[0][ROAD].astype(int) - other[0][ROAD]) for one, other in zip(ours, original, strict=True)]
    assert max(difference.mean() for difference in different) < 3.0
    assert all((row[0] % 4 == 0).all() for row in ours)  # fewer shades compress better
    dashboards = [np.abs(one[0][84:].astype(int) - other[0][84:]) for one, other in zip(ours, original, strict=True)]
    beside_the_score = [dashboard[:, 12:] for dashboard in dashboards]
    assert max(dashboard.mean() for dashboard in beside_the_score) < 5.0
    moved = [np.abs(before[0].astype(int) - after[0]).mean() for before, after in itertools.pairwise(ours)]
    assert np.mean(moved) > 3.0  # consecutive frames differ by more than the bounds above


@pytest.fixture(scope="module")
def accelerating() -> dict[str, np.ndarray]:
    """Road pixels at each physics step of 0.02 s at full gas, [81, 84, 96, 3], of both renderers, equally rounded."""
    frames = {}
    for backend in ("fast", "gymnasium"):
        environments = PlainEnvironments(make_environments(_spec(backend=backend, action_repeat=1), 1))
        shown = [environments.reset(11)[0].copy()]
        shown += [environments.step(np.array([1]))[0][0].copy() for _ in range(80)]
        environments.close()
        frames[backend] = (np.stack(shown)[:, ROAD].astype(int) + 2) // 4 * 4
    return frames


@pytest.mark.parametrize(("first", "last"), [(5, 45), (55, 79)], ids=["the camera zooms in", "the car is fast"])
def test_fast_camera_is_neither_ahead_nor_late(accelerating: dict[str, np.ndarray], first: int, last: int) -> None:
    def difference(shift: int) -> float:
        fast, original = accelerating["fast"], accelerating["gymnasium"]
        return float(np.abs(fast[first:last] - original[first + shift : last + shift]).mean())

    assert difference(0) < 0.5 * min(difference(-1), difference(1))
    assert difference(0) < 0.8


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.85, 0.0), (0.0, -0.95), (0.9, 0.9), (-0.99, 0.5)])
@pytest.mark.parametrize("angle", [0.0, 2.0])
def test_fast_renderer_shows_the_edge_of_the_field(place: tuple[float, float], angle: float) -> None:
    """Beyond the edge it is black."""
    frames = []
    for kind in (FastCarRacing, LateRenderedCarRacing):
        environment = kind()
        environment.reset(seed=3)
        environment.t = 2.0  # the camera is near
        assert environment.car is not None
        environment.car.destroy()
        environment.car = Car(environment.world, angle, *(PLAYFIELD * part for part in place))
        frames.append(environment.draw()[ROAD].astype(int))
        environment.close()
    assert np.abs(frames[0] - frames[1]).mean() < 2.0


def test_fast_backend_supports_car_racing_only() -> None:
    with pytest.raises(EnvironmentSetupError, match=r"fast supports CarRacing-v3 only, not CartPole-v1"):
        make_environments(EnvironmentSpec(id="CartPole-v1", backend="fast"), 1)


@pytest.mark.parametrize("backend", ["gymnasium", "fast"])
def test_missing_packages_are_reported(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [
        name
        for name in sys.modules
        if name.startswith(("gymnasium.envs.box2d", "daedalus.actor.environments.car_racing"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("Box2D", "pygame"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(EnvironmentSetupError, match=r'needs a package .* pip install "daedalus-rl\[box2d\]"'):
        make_environments(_spec(backend=backend), 1)


def brightened(environment: gymnasium.Env) -> gymnasium.Env:
    """A user's wrapper that reads the frames."""
    space = environment.observation_space
    return gymnasium.wrappers.TransformObservation(environment, lambda frame: np.minimum(frame, 235) + 20, space)


def test_user_wrapper_receives_the_frames() -> None:
    plain, wrapped = (
        PlainEnvironments(make_environments(_spec(), 1)),
        PlainEnvironments(make_environments(_spec(wrap=f"{__name__}:brightened"), 1, modules=TEST_MODULES)),
    )
    try:
        np.testing.assert_array_equal(wrapped.reset(3), np.minimum(plain.reset(3), 235) + 20)
    finally:
        plain.close()
        wrapped.close()


@pytest.mark.parametrize("backend", ["gymnasium", "fast"])
def test_gymnasiums_checker_sees_frames(backend: str) -> None:
    """Late rendering returns no frame before the wrapper that draws it."""
    assert not [note for note in gymnasium_notes(_spec(backend=backend), TEST_MODULES) if "Error" in note]


# ------------------------------------------------------------------------------------------ missed tiles


class Placed:
    """A car that is put on one tile after another, beside one whose tiles have no other rewards than gymnasium's."""

    def __init__(self) -> None:
        self.shaped: Any = FastCarRacing(missed_tile_reward=-10.0, lost_share=0.5)
        self.plain: Any = FastCarRacing()
        for environment in (self.shaped, self.plain):
            environment.reset(seed=3)
        self.tiles = len(self.shaped.track)
        self.shaping, self.terminated, self.truncated = 0.0, False, False

    def drive(self, *tiles: int) -> None:
        """Put the car on these tiles, with some steps on each."""
        for tile in tiles:
            for environment in (self.shaped, self.plain):
                environment.car.destroy()
                environment.car = Car(environment.world, *environment.track[tile % self.tiles][1:4])
            self.stand(3)

    def stand(self, frames: int) -> None:
        """Take steps without gas."""
        for _ in range(frames):
            _, shaped, self.terminated, self.truncated, _ = self.shaped.step(np.zeros(3))
            _, plain, self.plainly_terminated, *_ = self.plain.step(np.zeros(3))
            self.shaping += float(shaped) - float(plain)

    def leave_the_road(self) -> None:
        """Put the car on the grass, away from the track."""
        for environment in (self.shaped, self.plain):
            environment.car.destroy()
            environment.car = Car(environment.world, 0.0, *(2 * [0.9 * PLAYFIELD]))

    @property
    def missed(self) -> list[int]:
        return [tile.idx for tile in self.shaped.road if not tile.road_visited]


@pytest.fixture
def placed() -> Iterator[Placed]:
    placed = Placed()
    yield placed
    placed.shaped.close()
    placed.plain.close()


def test_each_tile_that_the_car_passes_without_touching_it_has_its_reward(placed: Placed) -> None:
    placed.drive(*range(40))
    assert (placed.shaping, placed.truncated) == (0.0, False)
    placed.drive(*range(52, 70))
    missed = [tile for tile in placed.missed if tile < 60]
    assert set(missed) >= {44, 45, 46}
    assert placed.shaping == pytest.approx(-10.0 * len(missed))
    placed.drive(*range(45, 70))  # a missed tile that the car returns to has cost its reward all the same
    assert placed.shaping == pytest.approx(-10.0 * len(missed))


def test_lap_with_missed_tiles_is_truncated_after_its_last_tile(placed: Placed) -> None:
    placed.drive(*range(40), *range(52, placed.tiles))
    assert not placed.truncated
    placed.drive(*range(placed.tiles, placed.tiles + 8))
    assert (placed.terminated, placed.truncated, placed.plainly_terminated) == (False, True, False)
    assert placed.missed
    assert placed.shaping == pytest.approx(-10.0 * len(placed.missed))


def test_another_part_of_the_track_and_the_road_behind_the_start_are_no_missed_tiles(placed: Placed) -> None:
    placed.drive(0, -1, -2, -3, 0, 1, 2, *range(100, 110))
    assert (placed.shaping, placed.truncated) == (0.0, False)


def test_lap_without_missed_tiles_is_truncated_and_not_terminated(placed: Placed) -> None:
    placed.drive(*range(placed.tiles))
    assert not placed.missed
    assert (placed.terminated, placed.truncated, placed.plainly_terminated) == (False, True, True)


def test_car_that_stays_off_the_road_is_lost_and_loses_half_of_its_return(placed: Placed) -> None:
    placed.drive(*range(30))
    placed.leave_the_road()
    placed.stand(59)
    placed.drive(0)  # it is back
    assert (placed.shaping, placed.terminated) == (0.0, False)
    placed.leave_the_road()
    placed.stand(59)
    assert (placed.shaping, placed.terminated) == (0.0, False)
    placed.stand(1)
    assert placed.plain.reward > 50.0
    assert placed.shaping == pytest.approx(-0.5 * placed.plain.reward)
    assert (placed.terminated, placed.truncated, placed.plainly_terminated) == (True, False, False)


def test_lost_car_whose_return_is_negative_loses_nothing(placed: Placed) -> None:
    placed.stand(300)
    placed.leave_the_road()
    placed.stand(60)
    assert placed.plain.reward < 0.0
    assert (placed.shaping, placed.terminated) == (0.0, True)


@pytest.mark.parametrize("backend", ["fast", "gymnasium"])
def test_missed_tiles_have_a_reward_in_training_only(backend: str) -> None:
    spec = _spec(backend=backend, training_kwargs={"missed_tile_reward": -10.0})
    environments: list[Any] = [EnvironmentFactory(spec=each)().unwrapped for each in (spec, spec.as_evaluated())]
    assert [environment._missed_tile_reward for environment in environments] == [-10.0, None]
