"""gymnasium's CarRacing, rendered only when a frame is needed; and a fast renderer that takes a tenth of the time.

A step of the original takes 0.1 ms of physics and 6 ms of drawing on a canvas of 1000 x 800, and a repeated action
discards all but the last frame. The physics here are gymnasium's own, so rewards and episodes are the same.
"""

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.box2d import car_racing  # first: its error names the packages that are missing
from pygame import Surface, draw, surfarray, transform

_WIDTH, _HEIGHT = 250, 200  # of the fast renderer's canvas: a quarter of the original's
_FARTHEST = math.hypot(_WIDTH / 2, _HEIGHT * 3 / 4)  # pixels from the car to the corners of the canvas
_GRASS = np.array([(x, y) for x in range(-20, 20, 2) for y in range(-20, 20, 2)]) * car_racing.GRASS_DIM
_CORNERS = np.array([[(1, 0)], [(0, 0)], [(0, 1)], [(1, 1)]])
_PATCHES = _GRASS + car_racing.GRASS_DIM * _CORNERS  # [4, 400, xy]
_BEHIND = 5  # tiles behind the wheel that is farthest ahead are passed: no other wheel touches them any more
_OFF_ROAD_FRAMES = 60  # a car that slides over the grass in a bend is back on the road before
_SHORT_CUT = 40  # a car that is so many tiles ahead has not driven there
_FIELD = car_racing.PLAYFIELD * (2 * _CORNERS - 1)  # [4, 1, xy]


class LateRenderedCarRacing(car_racing.CarRacing):
    """A CarRacing whose steps observe None; `draw` returns the frame that gymnasium's own would have."""

    _score = 0.0  # shown in the frame: the score before this step's reward

    def __init__(
        self, *, missed_tile_reward: float | None = None, lost_share: float | None = None, **kwargs: Any
    ) -> None:
        """Construct the environment. Both settings are for training: they change the task.

        gymnasium's ends a lap only when every tile of the track was touched. A car that has missed one, usually by
        cutting a corner, drives on until the time is over, which costs up to 40 of 1000 points; but nothing tells it
        when it misses the tile. And a car that has left the road has a long time before it is known to be lost.

        Args:
          missed_tile_reward: reward at each tile that the car passes without touching it. The lap then ends after its
            last tile, whether all were touched or not, and its end is a truncation, because it is no loss. None: as
            gymnasium's.
          lost_share: a car that has had no wheel on the road for 1.2 s is lost. Its episode terminates, and takes back
            this share of its return so far. A fixed loss that matters to a good policy delays the learning of one that
            has just begun (docs/results.md, "What was tried"). None: as gymnasium's.
          kwargs: of gymnasium's environment.
        """
        self._missed_tile_reward, self._lost_share = missed_tile_reward, lost_share
        self._passed = 0  # tiles from the start that the car has touched or passed
        self._off_road = 0  # frames in a row
        super().__init__(**kwargs)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        self._passed = self._off_road = 0
        return super().reset(**kwargs)

    def step(self, action: Any) -> Any:
        """See gymnasium.Env."""
        observation, reward, terminated, truncated, info = super().step(action)
        assert self.car is not None
        touched = {tile.idx for wheel in self.car.wheels for tile in wheel.tiles}
        if self._missed_tile_reward is not None:
            road = self.road
            assert road is not None
            reward += self._missed_tile_reward * self._pass_tiles(road, touched)
            if info.get("lap_finished") or self._passed == len(road):
                terminated, truncated = False, True
        self._off_road = 0 if touched else self._off_road + 1
        if self._lost_share is not None and self._off_road >= _OFF_ROAD_FRAMES and not truncated:
            reward -= self._lost_share * max(self.reward, 0.0)
            terminated = True
        return observation, reward, terminated, truncated, info

    def _pass_tiles(self, road: list[Any], touched: set[int]) -> int:
        """Return how many tiles of the road the car has missed since the last step; `touched` are those under it."""
        count = len(road)
        ahead = max(((index - self._passed) % count for index in touched), default=0)
        if ahead >= _SHORT_CUT:  # another part of the track, or before the start
            return 0
        passed = road[self._passed : self._passed + max(ahead - _BEHIND, 0)]
        self._passed += len(passed)
        return sum(not tile.road_visited for tile in passed)

    def _render(self, mode: str) -> Any:
        if mode != "state_pixels":
            return super()._render(mode)
        self._score = self.reward
        return None

    def draw(self) -> np.ndarray:
        """Return the current frame [96, 96, 3] uint8."""
        score, self.reward = self.reward, self._score
        try:
            frame = super()._render("state_pixels")
        finally:
            self.reward = score
        assert isinstance(frame, np.ndarray)
        return frame


class FastCarRacing(LateRenderedCarRacing):
    """A CarRacing drawn on a smaller canvas, without the parts out of sight and without the score."""

    def __init__(self, **kwargs: Any) -> None:
        """See LateRenderedCarRacing."""
        super().__init__(**kwargs)
        self._canvas = Surface((_WIDTH, _HEIGHT))
        self._frame = Surface((car_racing.STATE_W, car_racing.STATE_H))

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        started = super().reset(**kwargs)
        self._road = np.stack([corners for corners, _ in self.road_poly], axis=1)  # [4, N, xy]
        self._road_colours = [
            colour for _, colour in self.road_poly
        ]  # lists that change when the car drives over a tile
        return started

    def draw(self) -> np.ndarray:
        """Return the current frame [96, 96, 3] uint8; it differs from gymnasium's own by a few grey values."""
        assert self.car is not None
        hull = self.car.hull
        zoom = 0.1 * car_racing.SCALE * max(1 - self.t, 0) + car_racing.ZOOM * car_racing.SCALE * min(self.t, 1)
        zoom *= _WIDTH / car_racing.WINDOW_W
        cos, sin = math.cos(-hull.angle), math.sin(-hull.angle)
        turn = zoom * np.array([(cos, sin), (-sin, cos)])  # row vectors: metres -> pixels of the canvas
        position = np.array(hull.position)
        shift = np.array((_WIDTH / 2, _HEIGHT / 4)) - position @ turn

        if np.abs(position).max() + _FARTHEST / zoom < car_racing.PLAYFIELD:
            self._canvas.fill(self.bg_color)
        else:
            self._canvas.fill((0, 0, 0))
            self._draw_polygons(_FIELD @ turn + shift, [self.bg_color])
        self._draw_polygons(_PATCHES @ turn + shift, [self.grass_color] * len(_GRASS))
        self._draw_polygons(self._road @ turn + shift, self._road_colours)
        self.car.draw(self._canvas, zoom, shift, -hull.angle, draw_particles=False)
        self.surf = transform.flip(self._canvas, False, True)
        self._render_indicators(_WIDTH, _HEIGHT)
        transform.smoothscale(self.surf, self._frame.get_size(), self._frame)
        return _with_fewer_shades(np.ascontiguousarray(surfarray.pixels3d(self._frame).swapaxes(0, 1)))

    def _draw_polygons(self, polygons: np.ndarray, colours: list[Any]) -> None:
        """Draw those of `polygons` [4, N, xy] that reach into the canvas, in their order."""
        in_sight = (polygons.max(axis=0) >= 0.0) & (polygons.min(axis=0) <= (_WIDTH, _HEIGHT))
        for index in np.flatnonzero(in_sight.all(axis=1)).tolist():
            colour = [int(part) for part in colours[index]]
            draw.polygon(self._canvas, colour, polygons[:, index].tolist())


def _with_fewer_shades(frame: np.ndarray) -> np.ndarray:
    """Return a frame whose values are rounded to multiples of 4, at most 252: it compresses to a fifth less."""
    return np.minimum(frame, 253) + 2 & 0xFC


class RenderObservation(gymnasium.ObservationWrapper):
    """Observations drawn on demand. It must be the outermost wrapper, so that repeated steps draw once."""

    def observation(self, observation: Any) -> np.ndarray:
        """Return the current frame."""
        return self.unwrapped.draw()  # type: ignore[attr-defined]  # wraps a LateRenderedCarRacing
