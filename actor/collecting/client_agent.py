"""One agent of a loop that the caller owns: its rows, written as the loop reports observations and rewards."""

import logging
from collections.abc import Callable
from typing import Any

import gymnasium

from daedalus.actor.collecting.client_exchange import ClientExchange, LoadedPolicy
from daedalus.actor.collecting.client_rows import ClientRows
from daedalus.actor.collecting.client_seats import MatchSeat
from daedalus.actor.collecting.loop_recorder import EpisodeTape
from daedalus.actor.collecting.policy_guard import PolicyGuard
from daedalus.actor.environments.precision import FirstLosses
from daedalus.protocol.lessons import Parameters

_logger = logging.getLogger(__name__)


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
