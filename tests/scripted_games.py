"""Games whose course is drawn before they begin, and what each agent's rows must then be."""

import functools
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import AECEnv, ParallelEnv

Key = tuple[int, int, int]  # number of the match, of the agent, and of the action
PLAYED: dict[tuple[int, Key], int] = {}  # the actions that games were given, by the number of the game
_MOST_STEPS = 12


@dataclass
class Step:
    """One step of a match."""

    actors: list[int]
    rewards: dict[int, float]
    terminated: list[int]
    truncated: list[int]
    joined: list[int]


@dataclass
class Row:
    """What an action of an agent led to."""

    step: int
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    next: tuple[float, ...] = field(default=())


def match(seed: int, number: int, agents: int, *, together: bool) -> tuple[list[int], list[Step]]:
    """Return which agents are there at first, and the steps; some agents may never act."""
    random = np.random.default_rng([seed, number])
    while True:
        present = sorted(random.choice(agents, random.integers(1, agents + 1), replace=False).tolist())
        first, steps, acted, gone = list(present), [], set[int](), set[int]()
        while present and len(steps) < _MOST_STEPS:
            actors = list(present) if together else [int(random.choice(present))]
            acted.update(actors)
            ends = [agent for agent in present if random.random() < (0.15 if agent in acted else 0.03)]
            last = len(steps) == _MOST_STEPS - 1
            terminated = [agent for agent in ends if random.random() < 0.5]
            truncated = [agent for agent in (present if last else ends) if agent not in terminated]
            waiting = [agent for agent in range(agents) if agent not in present and agent not in gone]
            joined = [] if last else [agent for agent in waiting if random.random() < 0.3]
            rewards = {agent: float(random.integers(-3, 4)) for agent in present if random.random() < 0.7}
            steps.append(Step(actors, rewards, terminated, truncated, joined))
            gone.update(terminated, truncated)
            present = [agent for agent in (*present, *joined) if agent not in gone]
        if acted == set(range(agents)) or (acted and random.random() < 0.2):
            return first, steps


@functools.lru_cache(1024)
def rows(seed: int, number: int, agents: int, *, together: bool) -> dict[Key, Row]:
    """Return the rows of all agents in a match, by the rule that a reward belongs to the agent's newest action."""
    _, steps = match(seed, number, agents, together=together)
    found: dict[Key, Row] = {}
    newest: dict[int, Key] = {}
    for count, step in enumerate(steps):
        for agent in step.actors:
            newest[agent] = (number, agent, newest[agent][2] + 1 if agent in newest else 0)
            found[newest[agent]] = Row(count)
        for agent, reward in step.rewards.items():
            if agent in newest:  # else it has no action that could have earned it
                found[newest[agent]].reward += reward
        for agent in newest.keys() & step.terminated:
            found[newest[agent]].terminated = True
        for agent in newest.keys() & step.truncated:
            found[newest[agent]].truncated = True
    return found


def totals(seed: int, number: int, agents: int, *, together: bool) -> list[float]:
    """Return the sum of the rewards of each agent in a match, with those that come before its first action."""
    _, steps = match(seed, number, agents, together=together)
    return [sum(step.rewards.get(agent, 0.0) for step in steps) for agent in range(agents)]


class Scripted:
    """What both interfaces share."""

    metadata: ClassVar[dict] = {"name": "scripted", "is_parallelizable": False}
    render_mode = None
    made = 0

    def __init__(self, seed: int, agents: int, *, together: bool) -> None:
        self.script_seed, self.together = seed, together
        self.possible_agents = [f"agent_{number}" for number in range(agents)]
        self.agents: list[str] = []
        self.number = -1
        self.copy = Scripted.made
        Scripted.made += 1

    def observation_space(self, agent: str) -> Box:
        return Box(-1e6, 1e6, (3,), np.float32)

    def action_space(self, agent: str) -> Discrete:
        return Discrete(5)

    def begin(self) -> None:
        """Begin the next match."""
        self.number += 1
        first, self.steps = match(self.script_seed, self.number, len(self.possible_agents), together=self.together)
        self.agents = [self.possible_agents[each] for each in first]
        self.done, self.taken = 0, dict.fromkeys(self.possible_agents, 0)

    def seen(self, agent: str) -> np.ndarray:
        """Return the observation of an agent: the match, its number, and how many actions it has taken."""
        return np.array([self.number, self.possible_agents.index(agent), self.taken[agent]], np.float32)

    def note(self, agent: str, action: Any) -> None:
        """Keep an action."""
        PLAYED[self.copy, (self.number, self.possible_agents.index(agent), self.taken[agent])] = int(action)
        self.taken[agent] += 1

    def names(self, agents: Any) -> list[str]:
        """Return the names of agents."""
        return [self.possible_agents[agent] for agent in agents]


class Turns(Scripted, AECEnv):
    """The game with one agent after the other."""

    def __init__(self, seed: int, agents: int) -> None:
        super().__init__(seed, agents, together=False)

    def reset(self, seed: int | None = None, options: dict | None = None) -> None:
        self.begin()
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations, self.truncations = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict] = {agent: {} for agent in self.agents}
        self._skip_agent_selection = None
        self.agent_selection = self.names(self.steps[0].actors)[0]

    def observe(self, agent: str) -> np.ndarray:
        return self.seen(agent)

    def step(self, action: Any) -> None:
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        self.note(agent, action)
        self._cumulative_rewards[agent] = 0.0
        step = self.steps[self.done]
        self.done += 1
        given = {self.possible_agents[number]: reward for number, reward in step.rewards.items()}
        self.rewards = {each: given.get(each, 0.0) for each in self.agents}
        self._accumulate_rewards()
        for each in self.names(step.terminated):
            self.terminations[each] = True
        for each in self.names(step.truncated):
            self.truncations[each] = True
        for each in self.names(step.joined):
            self.agents.append(each)
            self.rewards[each] = self._cumulative_rewards[each] = 0.0
            self.terminations[each] = self.truncations[each] = False
            self.infos[each] = {}
        if self.done < len(self.steps):
            self.agent_selection = self.names(self.steps[self.done].actors)[0]
        self._deads_step_first()


class Seat(NamedTuple):
    """An agent that is no text."""

    number: int

    def __str__(self) -> str:
        return f"agent_{self.number}"


class Together(Scripted, ParallelEnv):
    """The game with all agents at once."""

    def __init__(self, seed: int, agents: int) -> None:
        super().__init__(seed, agents, together=True)
        self.possible_agents: list[Any] = [Seat(number) for number in range(agents)]

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        self.begin()
        return {agent: self.seen(agent) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        for agent in self.agents:
            self.note(agent, actions[agent])
        step = self.steps[self.done]
        self.done += 1
        given = {self.possible_agents[number]: reward for number, reward in step.rewards.items()}
        terminated, truncated = set(self.names(step.terminated)), set(self.names(step.truncated))
        here = list(self.agents)
        self.agents = [each for each in here if each not in terminated | truncated] + self.names(step.joined)
        every = {*here, *self.agents}
        return (
            {each: self.seen(each) for each in every},
            {each: given.get(each, 0.0) for each in here},
            {each: each in terminated for each in every},
            {each: each in truncated for each in every},
            {each: {} for each in every},
        )
