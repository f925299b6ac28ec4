"""Rock, paper, scissors: a game in which the newest policy forgets what it beat.

    daedalus train --env rock_paper_scissors:RockPaperScissors --set environment.backend=pettingzoo \
        --set training.entropy_bonus=0 --set training.entropy_bonus_final=none --set league.past_share=0 \
        --set league.rating_share=0.2 --env-steps 120000

Without a bonus for entropy, a policy that only meets itself goes round in a circle: from rock to paper, from paper to
scissors, from scissors to rock, until it no longer tries anything else. The matrix of its versions shows that each
beats some of the others and loses to some, so that no rating tells them apart. With past versions among the
opponents (leave out league.past_share), habits that one of them punishes pay less; without entropy the newest policy
still ends as a habit.
"""

from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv


class RockPaperScissors(ParallelEnv[str, np.ndarray, Any]):
    """One throw. There is nothing to see before it."""

    metadata = {"name": "rock_paper_scissors"}  # noqa: RUF012
    possible_agents = ["left", "right"]  # noqa: RUF012

    def observation_space(self, agent: str) -> Box:
        """Return the space of a number that is always 1."""
        return Box(0.0, 1.0, (1,), np.float32)

    def action_space(self, agent: str) -> Discrete:
        """Rock, paper, scissors."""
        return Discrete(3)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin a match."""
        self.agents = list(self.possible_agents)
        return self._seen(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> tuple[dict, dict, dict, dict, dict]:
        """Throw. Each choice beats the one before it: paper beats rock, scissors paper, rock scissors."""
        left, right = (int(actions[agent]) for agent in self.possible_agents)
        won = {0: 0.0, 1: 1.0, 2: -1.0}[(left - right) % 3]
        agents, self.agents = self.agents, []
        over, cut = dict.fromkeys(agents, True), dict.fromkeys(agents, False)
        return self._seen(), {"left": won, "right": -won}, over, cut, {agent: {} for agent in agents}

    def _seen(self) -> dict[str, np.ndarray]:
        return {agent: np.ones(1, np.float32) for agent in self.possible_agents}
