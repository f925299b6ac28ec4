"""Games of OpenSpiel in which players act in turns, as PettingZoo's AEC interface has them. `pip install open_spiel`.

    daedalus train --env open_spiel_game:OpenSpielGame --set environment.backend=pettingzoo \\
        --set environment.kwargs.game=leduc_poker

A player observes what it knows, with the past of the match where the game has them (the information state tensor).
Shimmy has an adapter too, but its release 2.0.1 counts the dealing of cards as moves, so that Kuhn poker is truncated
after its first one, and gives one player its last reward twice.
"""

from typing import Any

import numpy as np
import pyspiel  # pyright: ignore[reportMissingImports]
from gymnasium.spaces import Box, Discrete
from pettingzoo import AECEnv


class OpenSpielGame(AECEnv[str, np.ndarray, Any]):
    """A game of OpenSpiel, by its name."""

    def __init__(self, game: str, **parameters: Any) -> None:
        """Construct from the short name of a game and its parameters."""
        super().__init__()
        self.metadata = {"name": game}
        self.game = pyspiel.load_game(game, parameters)
        kind = self.game.get_type()
        if kind.dynamics != pyspiel.GameType.Dynamics.SEQUENTIAL:
            raise ValueError(f"{game} is not a game of turns: use pyspiel.convert_to_turn_based")
        self.possible_agents = [f"player_{number}" for number in range(self.game.num_players())]
        self.has_states = kind.provides_information_state_tensor
        shape = self.game.information_state_tensor_shape if self.has_states else self.game.observation_tensor_shape
        self.observed = Box(-np.inf, np.inf, tuple(shape()), np.float32)
        self.actions = Discrete(self.game.num_distinct_actions())
        self.random = np.random.default_rng()

    def observation_space(self, agent: str) -> Box:
        """Return the space of what a player knows."""
        return self.observed

    def action_space(self, agent: str) -> Discrete:
        """Return the space of all actions of the game; `action_mask` in info has those that are legal."""
        return self.actions

    def observe(self, agent: str) -> np.ndarray:
        """Return what a player knows."""
        player = self.possible_agents.index(agent)
        tensor = self.position.information_state_tensor if self.has_states else self.position.observation_tensor
        return np.array(tensor(player), np.float32).reshape(self.observed.shape)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begin a match."""
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.position = self.game.new_initial_state()
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.go_on()

    def step(self, action: Any) -> None:
        """Play the action of the player whose turn it is."""
        agent = self.agent_selection
        if self.terminations[agent]:
            self._was_dead_step(action)
            return
        self._cumulative_rewards[agent] = 0.0
        self.position.apply_action(int(action))
        self.go_on()

    def go_on(self) -> None:
        """Draw the moves of chance until a player has to act, and give the rewards of the step."""
        while self.position.is_chance_node():
            moves, probabilities = zip(*self.position.chance_outcomes(), strict=True)
            self.position.apply_action(int(self.random.choice(moves, p=probabilities)))
        ended = bool(self.position.is_terminal())
        self.infos = {}
        for player, agent in enumerate(self.agents):
            mask = np.zeros(self.actions.n, np.int8)
            mask[[] if ended else self.position.legal_actions(player)] = 1
            self.infos[agent] = {"action_mask": mask}
        self.rewards = dict(zip(self.agents, self.position.rewards(), strict=True))
        self._accumulate_rewards()
        self.terminations = dict.fromkeys(self.agents, ended)
        self.agent_selection = self.agents[0 if ended else self.position.current_player()]
