"""A duel of two paddles: `daedalus train --env duel:Duel --set environment.backend=pettingzoo` in this folder.

Each player moves a paddle up and down on its side of a court, and returns a ball that gets faster with each hit. The
further from the middle of the paddle it is hit, the steeper it flies. Who misses it loses the point; the first with
three points wins. Both see the court from their own side, so that one policy plays both.

    daedalus evaluate RUN --against random --games 200
    daedalus evaluate RUN --against OTHER_RUN
"""

import math
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

POINTS = 3  # to win
LIMIT = 1_500  # steps of a match, which then ends with the points so far
REACH = 0.18  # half the length of a paddle; the court is 2 by 2
PADDLE_SPEED = 0.05
SERVE_SPEED, FASTER, TOP_SPEED = 0.04, 1.06, 0.10
STEEPEST = math.radians(60)


class Duel(ParallelEnv[str, np.ndarray, Any]):
    """Two paddles and a ball."""

    metadata = {"name": "duel"}  # noqa: RUF012
    possible_agents = ["left", "right"]  # noqa: RUF012

    def observation_space(self, agent: str) -> Box:
        """Own paddle, other paddle, and place and velocity of the ball."""
        return Box(-2.0, 2.0, (6,), np.float32)

    def action_space(self, agent: str) -> Discrete:
        """Down, stay, up."""
        return Discrete(3)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin a match."""
        if seed is not None or not hasattr(self, "random"):
            self.random = np.random.default_rng(seed)
        self.agents, self.steps, self.points = list(self.possible_agents), 0, [0, 0]
        self.paddles = [0.0, 0.0]
        self.serve(int(self.random.integers(2)))
        return self.seen(), {agent: {} for agent in self.agents}

    def serve(self, to: int) -> None:
        """Put the ball in the middle, on its way to a side: 0 is left."""
        angle = self.random.uniform(-STEEPEST / 2, STEEPEST / 2)
        self.ball = [0.0, float(self.random.uniform(-0.5, 0.5))]
        self.speed = SERVE_SPEED
        self.velocity = [math.copysign(math.cos(angle), to - 0.5) * self.speed, math.sin(angle) * self.speed]

    def step(self, actions: dict[str, int]) -> tuple[dict, dict, dict, dict, dict]:
        """Move both paddles, then the ball."""
        for side, agent in enumerate(self.possible_agents):
            moved = self.paddles[side] + (int(actions[agent]) - 1) * PADDLE_SPEED
            self.paddles[side] = min(max(moved, REACH - 1.0), 1.0 - REACH)
        self.steps += 1
        loser = self.fly()
        rewards = [0.0, 0.0]
        if loser is not None:
            rewards[loser], rewards[1 - loser] = -1.0, 1.0
            self.points[1 - loser] += 1
            self.serve(loser)
        over = max(self.points) == POINTS
        late = not over and self.steps == LIMIT
        agents, seen = self.agents, self.seen()
        self.agents = [] if over or late else agents
        ended, cut = dict.fromkeys(agents, over), dict.fromkeys(agents, late)
        return seen, dict(zip(agents, rewards, strict=True)), ended, cut, {agent: {} for agent in agents}

    def fly(self) -> int | None:
        """Move the ball by one step; return the side that missed it, if one did."""
        x, y = self.ball[0] + self.velocity[0], self.ball[1] + self.velocity[1]
        if abs(y) > 1.0:  # off a wall
            y, self.velocity[1] = math.copysign(2.0, y) - y, -self.velocity[1]
        self.ball = [x, y]
        if abs(x) < 1.0:
            return None
        side = int(x > 0)
        offset = (y - self.paddles[side]) / REACH
        if abs(offset) > 1.0:
            return side
        self.speed = min(self.speed * FASTER, TOP_SPEED)
        angle = offset * STEEPEST
        self.velocity = [math.copysign(math.cos(angle), -x) * self.speed, math.sin(angle) * self.speed]
        self.ball[0] = math.copysign(2.0, x) - x
        return None

    def seen(self) -> dict[str, np.ndarray]:
        """Return what both see: for the right player, the court is mirrored."""
        (x, y), (dx, dy) = self.ball, self.velocity
        left, right = self.paddles
        scaled = 1.0 / TOP_SPEED
        return {
            "left": np.array([left, right, x, y, dx * scaled, dy * scaled], np.float32),
            "right": np.array([right, left, -x, y, -dx * scaled, dy * scaled], np.float32),
        }
