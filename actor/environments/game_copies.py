"""One copy of a game, stepped until agents of the policy must act, whichever of PettingZoo's two interfaces it has."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import gymnasium

from daedalus.actor.checking.violations import flag_violations
from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described, raise_problem
from daedalus.actor.environments.info import MASK_KEY
from daedalus.protocol.spec import EnvironmentSpec
from daedalus.protocol.texts import listed

_MOST_EMPTY_MATCHES = 100  # in a row, in which no agent with a seat has a part
_MOST_IDLE_TURNS = 100_000  # of agents without a seat, between two turns of the seats

_OF_ALL = "__all__"  # an entry that environments for RLlib have beside those of the agents

OtherAction = Callable[[str, Any, Any], Any]  # of an agent without a seat, for its observation and info
LostReward = Callable[[str, float], None]  # notes the reward of an agent with a seat that has left


class Outcome(NamedTuple):
    """What is new for one agent: an observation to act on, or the last one of its episode."""

    agent: str
    observation: Any
    reward: float  # since its last action
    terminated: bool
    truncated: bool
    info: Mapping[str, Any]


class GameCopy(Protocol):
    """One copy of a game."""

    def reset(self, seed: int | None) -> list[Outcome]:
        """Begin a match, and return what is new for its first agents."""
        ...

    @property
    def turns(self) -> Sequence[str]:
        """The agents with a seat that must act next."""
        ...

    def step(self, actions: Mapping[str, Any]) -> list[Outcome]:
        """Play on with the actions of the agents that must act, until an agent with a seat has something new."""
        ...

    @property
    def is_over(self) -> bool:
        """Whether the match has ended for all agents."""
        ...


def game_copy(environment: Any, seats: Sequence[str], others: OtherAction, lost_reward: LostReward) -> GameCopy:
    """Return a copy of a game as one of these, for a PettingZoo environment."""
    if hasattr(environment, "agent_iter"):
        return _TurnGame(environment, seats, others)
    return _SimultaneousGame(environment, seats, others, lost_reward)


def without_checks(environment: Any, spec: EnvironmentSpec) -> Any:
    """Return an environment without PettingZoo's outer wrappers that only check or correct what its caller does.

    They take most of the time of a small game. Here calls are always in order, and actions always in their space and
    legal by the mask: the wrappers would change nothing.
    """
    try:
        from pettingzoo.utils import wrappers
        from pettingzoo.utils.conversions import aec_to_parallel_wrapper
    except ImportError:  # an environment with the same interface, of somebody who does without it
        return environment
    if type(environment) is aec_to_parallel_wrapper:
        environment.aec_env = without_checks(environment.aec_env, spec)
        return environment
    agent = environment.possible_agents[0]
    spaces = environment.observation_space(agent), environment.action_space(agent)
    checks: tuple[type, ...] = (
        wrappers.OrderEnforcingWrapper,
        wrappers.AssertOutOfBoundsWrapper,
        wrappers.ClipOutOfBoundsWrapper,
    )
    masked = isinstance(spaces[0], gymnasium.spaces.Dict) and MASK_KEY in spaces[0].spaces
    if masked and MASK_KEY not in spec.leave_out and isinstance(spaces[1], gymnasium.spaces.Discrete):
        checks = (*checks, wrappers.TerminateIllegalWrapper)
    while type(environment) in checks:
        environment = environment.env
    return environment


class _TurnGame:
    """A game whose agents act one after the other (PettingZoo's AEC interface)."""

    def __init__(self, environment: Any, agents: Sequence[str], others: OtherAction) -> None:
        self._environment, self._agents, self._others = environment, frozenset(agents), others
        self._turn: str | None = None  # the agent of ours that must act
        self._playing = dict[str, None]()  # the agents of ours that have acted, and whose end is still to come

    def reset(self, seed: int | None) -> list[Outcome]:
        """See GameCopy."""
        for _ in range(_MOST_EMPTY_MATCHES):
            self._environment.reset(seed=seed)
            self._turn = None
            self._playing.clear()
            if outcomes := self._advance():
                return outcomes
            seed = None  # no agent with a seat had a part in the match: the next one
        raise _none()

    @property
    def turns(self) -> Sequence[str]:
        """See GameCopy."""
        return () if self._turn is None else (self._turn,)

    def step(self, actions: Mapping[str, Any]) -> list[Outcome]:
        """See GameCopy."""
        if self._turn is not None:
            action = actions[self._turn]
            self._playing[self._turn] = None
            self._turn = None
            self._environment.step(action)
        return self._advance()

    @property
    def is_over(self) -> bool:
        """See GameCopy."""
        return not self._environment.agents

    def _advance(self) -> list[Outcome]:
        """Return what is new up to the next turn of an agent of ours, at most once for each agent."""
        environment, outcomes = self._environment, dict[str, Outcome]()
        for _ in range(_MOST_IDLE_TURNS):
            if not environment.agents:
                if self._playing:
                    raise _without_end(next(iter(self._playing)))
                return list(outcomes.values())
            agent = environment.agent_selection
            if agent in outcomes:  # the next call passes it on
                return list(outcomes.values())
            observation, reward, terminated, truncated, info = environment.last()
            ends = _flag(agent, "terminated", terminated), _flag(agent, "truncated", truncated)
            ended = any(ends)
            if agent in self._agents:
                outcomes[agent] = Outcome(agent, observation, _number(agent, reward), *ends, info)
                if not ended:
                    self._turn = agent
                    return list(outcomes.values())
                self._playing.pop(agent, None)
            environment.step(None if ended else self._others(agent, observation, info))
            if ended and agent in environment.agents:
                raise _stays(agent, "step(None)", "call _was_dead_step(action) there and return")
        raise _idle()


def _none() -> EnvironmentSetupError:
    return EnvironmentSetupError(f"no agent can act after reset, in {_MOST_EMPTY_MATCHES} matches one after the other")


def _idle() -> EnvironmentSetupError:
    return EnvironmentSetupError(f"no agent of the policy had a turn in {_MOST_IDLE_TURNS:,} turns of the others")


def _stays(agent: str, call: str, remedy: str) -> EnvironmentSetupError:
    return EnvironmentSetupError(f"{agent} has ended, but is still in its `agents` after {call}: {remedy}")


def _without_end(agent: str) -> EnvironmentSetupError:
    return EnvironmentSetupError(
        f"{agent} has left its `agents` without an end: each agent must have a last observation with its "
        "termination or truncation"
    )


def _number(agent: str, reward: Any) -> float:
    try:
        return float(reward)
    except (TypeError, ValueError):
        raise EnvironmentSetupError(f"{agent} has the reward {described(reward)}: it must be a number") from None


def _flag(agent: str, name: str, flag: Any) -> bool:
    if not isinstance(flag, bool):
        raise_problem(agent, flag_violations(name, flag))
    return bool(flag)


class _SimultaneousGame:
    """A game whose agents act together (PettingZoo's parallel interface)."""

    def __init__(self, environment: Any, agents: Sequence[str], others: OtherAction, lost_reward: LostReward) -> None:
        self._environment, self._agents, self._others = _in_rounds(environment), frozenset(agents), others
        self._lost_reward = lost_reward
        self._possible = dict.fromkeys(environment.possible_agents)
        self._seen: dict[str, tuple[Any, Any]] = {}  # newest observation and info of the agents that are not ours

    def reset(self, seed: int | None) -> list[Outcome]:
        """See GameCopy."""
        for _ in range(_MOST_EMPTY_MATCHES):
            observations, infos = self._environment.reset(seed=seed)
            outcomes = self._outcomes(self._environment.agents, observations, {}, {}, {}, infos) or self.step({})
            if outcomes:
                return outcomes
            seed = None  # no agent with a seat had a part in the match: the next one
        raise _none()

    @property
    def turns(self) -> Sequence[str]:
        """See GameCopy."""
        return [agent for agent in self._environment.agents if agent in self._agents]

    def step(self, actions: Mapping[str, Any]) -> list[Outcome]:
        """See GameCopy."""
        for _ in range(_MOST_IDLE_TURNS):
            outcomes = self._step_once(actions)
            if outcomes or self.is_over:
                return outcomes
        raise _idle()

    def _step_once(self, actions: Mapping[str, Any]) -> list[Outcome]:
        before = tuple(self._environment.agents)
        chosen = {
            agent: actions[agent] if agent in self._agents else self._others(agent, *self._seen[agent])
            for agent in before
        }
        observations, rewards, terminated, truncated, infos = self._environment.step(chosen)
        self._refuse_others({"rewards": rewards, "terminations": terminated, "truncations": truncated})
        came = [agent for agent in self._environment.agents if agent not in before]
        outcomes = self._outcomes((*before, *came), observations, rewards, terminated, truncated, infos)
        here = set(self._environment.agents)
        over = terminated.get(_OF_ALL) or truncated.get(_OF_ALL)
        for agent, _, _, ended, cut, _ in outcomes:
            if (ended or cut or over) and agent in here:
                raise _stays(agent, "its last step", "remove it there")
            if not (ended or cut or agent in here):
                raise _without_end(agent)
        if len(rewards) > len(outcomes):
            for agent in self._agents.intersection(rewards).difference(before, came):
                if reward := _number(agent, rewards[agent]):
                    self._lost_reward(agent, reward)
        return outcomes

    def _refuse_others(self, results: Mapping[str, Mapping[str, Any]]) -> None:
        """Raise EnvironmentSetupError for a result of nobody: what an agent has no entry in is 0 or False for it."""
        for name, values in results.items():
            if not values.keys() <= self._possible.keys() and (
                others := values.keys() - self._possible.keys() - {_OF_ALL}
            ):
                raise EnvironmentSetupError(
                    f"its {name} have an entry for {min(others, key=str)!r}, which is no agent: its possible_agents "
                    f"are {listed([*self._possible])}"
                )

    @property
    def is_over(self) -> bool:
        """See GameCopy."""
        return not self._environment.agents

    def _outcomes(
        self,
        agents: Sequence[str],
        observations: Mapping[str, Any],
        rewards: Mapping[str, float],
        terminated: Mapping[str, bool],
        truncated: Mapping[str, bool],
        infos: Mapping[str, Any],
    ) -> list[Outcome]:
        missing = [agent for agent in agents if agent not in observations]
        if missing:
            raise EnvironmentSetupError(
                f"there is no observation of {missing[0]} after its action: return one of each agent that acted, "
                "also of those that leave with this step"
            )
        self._seen = {
            agent: (observations[agent], infos.get(agent, {})) for agent in agents if agent not in self._agents
        }
        return [
            Outcome(
                agent,
                observations[agent],
                _number(agent, rewards.get(agent, 0.0)),
                _flag(agent, "terminated", terminated.get(agent, False)),
                _flag(agent, "truncated", truncated.get(agent, False)),
                infos.get(agent, {}),
            )
            for agent in agents
            if agent in self._agents
        ]


def _in_rounds(environment: Any) -> Any:
    """Return a parallel environment; in place of PettingZoo's conversion of an AEC environment _Rounds."""
    try:
        from pettingzoo.utils.conversions import aec_to_parallel_wrapper
    except ImportError:  # see without_checks
        return environment
    return _Rounds(environment) if type(environment) is aec_to_parallel_wrapper else environment


class _Rounds:
    """A parallel environment made of an AEC environment whose agents take turns in rounds.

    It does what PettingZoo's conversion does, without its observations between the turns, which nobody reads: the
    pictures of most games take longer than their steps.
    """

    def __init__(self, conversion: Any) -> None:
        self._conversion, self._game = conversion, conversion.aec_env

    @property
    def agents(self) -> list[str]:
        """The agents that must act."""
        return self._game.agents

    def reset(self, seed: int | None) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """See pettingzoo.ParallelEnv."""
        return self._conversion.reset(seed=seed)

    def step(self, actions: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
        """See pettingzoo.ParallelEnv."""
        game, rewards = self._game, dict[str, float]()
        for agent in game.agents:
            if agent != game.agent_selection:
                raise EnvironmentSetupError(
                    f"it is the turn of {game.agent_selection} in place of {agent}: agents that act together must have "
                    "turns in the order of `agents`, and leave at the end of a round"
                )
            game.step(actions[agent])
            for each in game.agents:
                rewards[each] = rewards.get(each, 0.0) + game.rewards[each]
        terminated, truncated, infos = dict(game.terminations), dict(game.truncations), dict(game.infos)
        observations = {agent: game.observe(agent) for agent in game.agents}
        while game.agents and (game.terminations[game.agent_selection] or game.truncations[game.agent_selection]):
            game.step(None)
        return observations, rewards, terminated, truncated, infos
