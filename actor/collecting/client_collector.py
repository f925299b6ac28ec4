"""Rollouts from a loop that the caller owns: its agents, the service's side, and what their threads hand to each other.

The agents write their rows on the caller's thread, as the loop reports observations and rewards. The service takes full
rollouts from the exchange, and gives it policies.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.collecting.client_rows import ClientRows, check_run
from daedalus.actor.collecting.client_seats import MatchSeat, match_seats, seated_space
from daedalus.actor.collecting.loop_recorder import EpisodeTape
from daedalus.actor.collecting.policy_guard import PolicyGuard
from daedalus.actor.environments.components import without
from daedalus.actor.environments.info import mask_of_one
from daedalus.actor.environments.precision import FirstLosses
from daedalus.actor.environments.transforms import Transforms
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.protocol.lessons import LessonPlan, Parameters
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_logger = logging.getLogger(__name__)


def side_by_side(rollouts: Sequence[Rollout]) -> Rollout:
    """Return a rollout whose environments are those of the given ones, in their order.

    All have the same T, the same spaces and the same policy version; the identity is that of the first. Their
    `episode_info` must be empty: it is that of environments which an actor steps.
    """
    first, *others = rollouts
    if not others:
        return first
    return replace(
        first,
        frames=_joined([each.frames for each in rollouts]),
        initial_state=np.concatenate([each.initial_state for each in rollouts]),
        actions=_joined([each.actions for each in rollouts]),
        masks=_joined([each.masks for each in rollouts]),
        behaviour_log_probs=np.concatenate([each.behaviour_log_probs for each in rollouts], axis=1),
        rewards=np.concatenate([each.rewards for each in rollouts], axis=1),
        terminated=np.concatenate([each.terminated for each in rollouts], axis=1),
        truncated=np.concatenate([each.truncated for each in rollouts], axis=1),
        valid=np.concatenate([each.valid for each in rollouts], axis=1),
        episode_returns=np.concatenate([each.episode_returns for each in rollouts]),
        episode_lengths=np.concatenate([each.episode_lengths for each in rollouts]),
        lessons=_episodes_joined([each.lessons for each in rollouts]),
        overridden=_flags([each.overridden for each in rollouts], first.valid),
        taught=_flags([each.taught for each in rollouts], first.valid),
        game_steps=None if first.game_steps is None else sum(each.env_steps for each in rollouts),
    )


def _flags(parts: Sequence[np.ndarray | None], like: np.ndarray) -> np.ndarray | None:
    if all(part is None for part in parts):
        return None
    return np.concatenate([np.zeros_like(like) if part is None else part for part in parts], axis=1)


def _episodes_joined(lessons: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the parameters of the episodes of all rollouts; one without an episode has none."""
    played = [each for each in lessons if each]
    return {name: np.concatenate([each[name] for each in played]) for name in (played[0] if played else ())}


def _joined(arrays: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([each[name] for each in arrays], axis=1) for name in arrays[0]}


_MAX_FULL_ROLLOUTS = 8  # of each agent, that the service has not taken yet; beyond that the oldest is dropped


@dataclass(frozen=True, slots=True)
class LoadedPolicy:
    """One version of the policy, ready to act."""

    version: int
    runtime: OnnxRuntime
    lessons: LessonPlan | None = None  # in a run with lessons


class ClientExchange:
    """The state that both threads use. No call waits for the other thread."""

    def __init__(self, agents: int) -> None:
        """`agents` is the number of agents in the caller's loop."""
        self._agents = agents
        self._lock = threading.Lock()  # guards everything below
        self._dropped = 0
        self._together = False  # the agents' rollouts are sent as one
        self._begun: list[ClientRows] = []  # by agent, under a policy that has begun and has no weights yet
        self._newest: LoadedPolicy | None = None  # None before the weights of the policy that has begun
        # By agent: a policy that can act, and the first rows under it. None once the agent acts with it.
        self._next: list[tuple[ClientRows, LoadedPolicy] | None] = [None] * agents
        self._confirmed_at = -math.inf  # the monotonic time at which the newest policy was the learner's newest
        self._may_begin = [True] * agents  # whether the agent's next row may begin a rollout
        self._parts: dict[int, Rollout] = {}  # full rollouts by agent, while they wait for those of the others
        # By agent, in turns: agents fill their rollouts together, and the first would else have all that are taken.
        self._full: dict[int, deque[Rollout]] = {agent: deque() for agent in range(agents)}

    @property
    def dropped(self) -> int:
        """Number of rollouts, finished or not, that the service never took."""
        return self._dropped

    # -------------------------------------------------------------------------------- for the service's thread

    def begin(self, rows: list[ClientRows], *, together: bool) -> None:
        """Offer the rows of each agent under another policy. Drop the full rollouts of the previous one.

        With `together`, one rollout of each agent makes one of the client, and the agents begin the next ones when the
        service has asked for it.
        """
        with self._lock:
            self._begun, self._newest, self._together = rows, None, together
            self._may_begin = [not together] * self._agents
            self._dropped += sum(map(len, self._full.values())) + len(self._parts)
            for full in self._full.values():
                full.clear()
            self._parts.clear()

    def offer(self, policy: LoadedPolicy) -> None:
        """Let newer weights act."""
        with self._lock:
            self._newest = policy
            if self._begun:
                self._next = [(rows, policy) for rows in self._begun]
                self._begun = []

    def confirm(self, at: float) -> None:
        """Note that the newest policy was the learner's newest at a monotonic time, in seconds."""
        with self._lock:
            self._confirmed_at = at

    def has_rollout(self) -> bool:
        """Return whether `take` would return a rollout now. Safe from any thread."""
        return any(map(len, list(self._full.values())))

    def take(self) -> Rollout | None:
        """Return the oldest full rollout of the next agent in turn; without any, the agents may begin rollouts."""
        with self._lock:
            for agent, full in self._full.items():
                if full:
                    self._full[agent] = self._full.pop(agent)  # its turn comes last
                    return full.popleft()
            self._may_begin = [agent not in self._parts for agent in range(self._agents)]
            return None

    # --------------------------------------------------------------------------------- for the caller's thread

    def next_rows(self, agent: int) -> tuple[ClientRows, LoadedPolicy] | None:
        """Return, once, the agent's rows under a policy that has begun meanwhile, if it can act by now."""
        with self._lock:
            found, self._next[agent] = self._next[agent], None
            return found

    def newest_policy(self, agent: int) -> LoadedPolicy | None:
        """Return the newest weights; None if they are of a policy that begins, and not for the rows in use."""
        with self._lock:
            return self._newest if self._next[agent] is None else None

    def policy_age(self) -> float:
        """Return the seconds since the newest policy was last known to be the learner's newest."""
        with self._lock:
            return time.monotonic() - self._confirmed_at

    def may_begin(self, agent: int) -> bool:
        """Return whether the agent's next row may begin a rollout."""
        with self._lock:
            return self._may_begin[agent]

    def drop(self) -> None:
        """Count an unfinished rollout that is dropped."""
        with self._lock:
            self._dropped += 1

    def keep(self, agent: int, rollout: Rollout) -> None:
        """Keep a full rollout of an agent for the service, unless its policy is that of a previous learner."""
        with self._lock:
            if self._newest is None or self._next[agent] is not None:
                self._dropped += 1
            elif self._together:
                self._keep_part(agent, rollout)
            else:
                self._append(agent, rollout)

    def _keep_part(self, agent: int, rollout: Rollout) -> None:
        """Keep a rollout until every agent has one of the same policy version."""
        self._may_begin[agent] = False
        self._parts[agent] = rollout
        newest = max(part.policy_version for part in self._parts.values())
        for other in [each for each, part in self._parts.items() if part.policy_version < newest]:
            del self._parts[other]
            self._dropped += 1
            self._may_begin[other] = True
        if len(self._parts) == self._agents:
            self._append(0, side_by_side([self._parts[each] for each in range(self._agents)]))
            self._parts.clear()

    def _append(self, agent: int, rollout: Rollout) -> None:
        full = self._full[agent]
        full.append(rollout)
        if len(full) > _MAX_FULL_ROLLOUTS:
            full.popleft()
            self._dropped += 1


class ClientAgent:
    """One agent, with episodes and rollouts of its own. For the caller's thread.

    Of a match whose agents act in turns, call `act` at the turn of this agent only; rewards that come between its turns
    belong to its last action.

    A rollout is played with one policy version. In a run whose actors wait for each update, the agent goes on with the
    last policy meanwhile, and those rows are not written.
    """

    def __init__(
        self, index: int, exchange: ClientExchange, guard: PolicyGuard, check: Callable[[], None] = lambda: None
    ) -> None:
        """Construct the agent.

        Args:
          index: the agent's number in `exchange`.
          exchange: gives the policy and takes the rollouts.
          guard: decides when the safe action is played.
          check: raises what has ended the client's thread.
        """
        self._index, self._exchange, self._guard, self._check = index, exchange, guard, check
        self.seat: MatchSeat | None = None  # in the match that the loop hosts
        self.tape: EpisodeTape | None = None  # records the episodes, if somebody asked for it
        self._rows: ClientRows | None = None
        self._loaded: LoadedPolicy | None = None  # that acts
        self.actions = self.overridden_actions = self.safe_actions = 0
        self._losses: FirstLosses | None = None
        self._told = set[str]()  # components whose losses were reported

    def watch(self, space: gymnasium.Space) -> None:
        """Warn of what float32 loses of the next observations, of which a space has the components that are read."""
        self._losses = FirstLosses(space, self._told)

    def act(self, observation: Any, action_mask: Any = None, *, override: Any = None) -> Any:
        """Return the action to take now. After the end of the run it is the last policy's, and nobody learns from it.

        Args:
          observation: of the observation space.
          action_mask: the legal choices, if the client was constructed with a mask: of the same form.
          override: the action of a person or a safety filter, which is played in place of the policy's: `act` returns
            it. The policy's memory goes on. It is learned from in a run that learns from demonstrations (`sac`), if it
            is in the action space; in other runs it is not.

        Raises ValueError if the observation or the mask does not fit the spaces, ActorError if the learner quarantined
        this actor, and whatever else ended the client's thread.
        """
        self._check()
        self._switch_policy()
        rows = self._rows
        assert rows is not None  # a Client waits for the first policy
        rows.observe(observation, action_mask)
        self.actions += 1
        for text in self._losses.add(observation) if self._losses is not None else ():
            _logger.warning("%s", text)
        while True:
            if rows.is_between_rollouts:
                self._load_newest(rows)
            policy_acts = self._policy_may_act()
            actions = rows.choose(override=override, idle=self._is_idle(rows, policy_acts=policy_acts))
            if actions is not None:
                break
        if override is not None:
            self.overridden_actions += 1
            action = override
        elif not policy_acts:
            self.safe_actions += 1
            action = self._guard.action(observation)
        else:
            action = rows.env_action(actions)
        if self.tape is not None:
            self.tape.act(observation, action)
        return action

    @property
    def parameters(self) -> Parameters:
        """The parameters of the environment, by name, of the running episode or else of the one that begins next.

        Those of `environment.parameters` in the run, as its lessons vary them. Empty in a run without parameters; in
        one with them, read it before the first `act` of each episode. Raises what has ended the client's thread.
        """
        self._check()
        self._switch_policy()
        assert self._rows is not None  # a Client waits for the first policy
        if self._rows.is_between_rollouts:
            self._load_newest(self._rows)
        return dict(self._rows.parameters)

    def reward(self, value: float) -> None:
        """Add `value` to the reward of the last action; any number of times until the next `act`.

        A reward after `end_episode` still belongs to the last action of that episode. Raises ValueError if `value` is
        not finite, or before the first action of an episode.
        """
        if self._rows is None:
            raise ValueError("a reward came before any action: call act() first")
        self._rows.reward(value)
        if self.tape is not None:
            self.tape.reward(value)

    def success(self, reward: float = 1.0, observation: Any = None) -> None:
        """Reward the last action for reaching the goal, and end the episode as terminated: for a key or a button.

        Args:
          reward: added to the reward of the last action.
          observation: see end_episode.

        Raises ValueError as `reward` and `end_episode`.
        """
        self.reward(reward)
        self.end_episode(terminated=True, observation=observation)

    def end_episode(self, *, terminated: bool, observation: Any = None) -> None:
        """End the episode; the next `act` begins another one.

        Args:
          terminated: True if the environment ended the episode; False if a limit truncated it.
          observation: the last one. Required for the bootstrap value: after a truncation, and after a termination in
            a run with environment.bootstrap_terminations.

        Raises ValueError if the episode has no action yet, or the observation is missing or does not fit the space.
        """
        if self._rows is None:
            raise ValueError("the episode ended without any action: call act() first")
        self._rows.end_episode(observation, terminated=terminated)
        if self.tape is not None:
            self.tape.end(observation, terminated=terminated)

    def keep(self, rows: ClientRows) -> None:
        """Hand over a full rollout. Called by the agent's rows."""
        assert self._loaded is not None
        self._exchange.keep(self._index, rows.finished_copy(self._loaded.version))

    def _switch_policy(self) -> None:
        """Continue with a policy that has begun meanwhile; drop the unfinished rollout of the previous one."""
        begun = self._exchange.next_rows(self._index)
        if begun is None:
            return
        if self._rows is not None and not self._rows.is_between_rollouts:
            self._exchange.drop()
        before = self._rows
        self._rows, self._loaded = begun
        self._rows.use(self._loaded.runtime, self._loaded.lessons)
        if before is not None:
            self._rows.take_over(before)

    def _load_newest(self, rows: ClientRows) -> None:
        """Let the newest weights act."""
        newest = self._exchange.newest_policy(self._index)
        if newest is not None and newest is not self._loaded:
            self._loaded = newest
            rows.use(newest.runtime, newest.lessons)

    def _policy_may_act(self) -> bool:
        """Return whether the policy may act now, and not the safe action."""
        assert self._loaded is not None
        return self._guard.allows(self._loaded.version, self._exchange.policy_age())

    def _is_idle(self, rows: ClientRows, *, policy_acts: bool) -> bool:
        """Return whether the next row is not written. Count the unfinished rollout that this drops."""
        if policy_acts:
            return rows.is_between_rollouts and not self._exchange.may_begin(self._index)
        if not rows.is_between_rollouts:
            self._exchange.drop()
        return True


class ClientCollector:
    """A Collector whose rows the agents of the caller's loop make, on the caller's thread.

    Neither thread waits for the other. Each rollout is one agent's, of one environment. In a run whose actors wait for
    each update, a rollout is of all agents, as that of an actor with as many environments.
    """

    lineup = None  # the caller decides who plays

    def __init__(
        self,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        example_mask: Any,
        guard: PolicyGuard | None = None,
        *,
        agents: int = 1,
        seats: Sequence[str] = (),
        turns: bool = True,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Construct the collector.

        Args:
          observation_space, action_space: those of each agent.
          example_mask: a mask, or a map of masks by action component, if the loop has masks; else None.
          guard: decides when the safe action is played; None: never.
          agents: number of agents.
          seats: names of the seats of each match, which the agents hold in this order, match after match; or none.
          turns: see match_seats.
          check: called before each `act`; raises what has ended the service.
        """
        self._observation_space, self._action_space = observation_space, action_space
        self._example_mask = example_mask
        self.guard = guard or PolicyGuard(action_space, None, None, untrained=False)
        self.policy_loaded = threading.Event()  # the caller may act
        self.on_rollout: Callable[[], None] = lambda: None  # called on the caller's thread when a rollout is full
        self._transforms: Transforms | None = None  # of the run that is being joined
        self._program: OnnxRuntime | None = None
        self._plan: LessonPlan | None = None  # the newest, in a run with lessons
        self._exchange = ClientExchange(agents)
        self.agents = tuple(ClientAgent(index, self._exchange, self.guard, check) for index in range(agents))
        for first in range(0, agents if seats else 0, max(len(seats), 1)):
            for seat in match_seats(seats, turns=turns):
                self.agents[first + seat.number].seat = seat

    @property
    def dropped(self) -> int:
        """Number of rollouts, finished or not, that the service never took."""
        return self._exchange.dropped

    @property
    def has_joined(self) -> bool:
        """Whether a learner has accepted the client, and its program has come."""
        return self._program is not None

    def prepare(self, spec: ActorSpec) -> tuple[Spaces, int]:
        """See Collector."""
        check_run(spec)
        example = None if self._example_mask is None else mask_of_one(self._example_mask)
        observed = [seated_space(spec, agent.seat, self._observation_space) for agent in self.agents]
        self._transforms = Transforms(spec.environment, observed[0], self._action_space, example)
        for agent in self.agents:
            agent.watch(without(self._observation_space, spec.environment.leave_out))
        return self._transforms.spaces, len(self.agents) if spec.algorithm.synchronous else 1

    def begin(self, runtime: PolicyRuntime, spec: ActorSpec, seed: int, epsilon: float = 0.0) -> None:
        """See Collector. Discard the rollouts of the previous policy."""
        assert isinstance(runtime, OnnxRuntime)  # a client has no other
        self._program = runtime
        self._plan = None
        rows = [self._rows(agent, spec, (seed, index), epsilon) for index, agent in enumerate(self.agents)]
        self._exchange.begin(rows, together=spec.algorithm.synchronous)

    def _rows(self, agent: ClientAgent, spec: ActorSpec, seed: tuple[int, int], epsilon: float) -> ClientRows:
        assert self._transforms is not None
        assert self._program is not None

        def keep(full: ClientRows) -> None:
            agent.keep(full)
            self.on_rollout()

        return ClientRows(
            spec,
            self._transforms,
            self._program,
            np.random.default_rng(seed),
            on_full=keep,
            has_masks=self._example_mask is not None,
            epsilon=epsilon,
            seat=agent.seat,
        )

    def load(self, snapshot: Snapshot) -> None:
        """See Collector. Loading takes long for a large network: it is done here and not in the caller's loop."""
        assert self._program is not None
        runtime = self._program.fork()
        runtime.load(snapshot.weights)
        self._plan = snapshot.lessons or self._plan
        self._exchange.offer(LoadedPolicy(snapshot.policy_version, runtime, self._plan))

    def confirm(self, at: float) -> None:
        """See Collector."""
        self._exchange.confirm(at)
        self.policy_loaded.set()

    def has_rollout(self) -> bool:
        """Return whether `collect` would return a rollout now. Safe from any thread."""
        return self._exchange.has_rollout()

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout | None:
        """See Collector. Return an agent's oldest full rollout. `on_row` has no effect: the loop makes the rows."""
        rollout = self._exchange.take()
        return None if rollout is None else replace(rollout, identity=identity)

    def close(self) -> None:
        """See Collector. There is nothing to release."""
