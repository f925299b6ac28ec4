"""What a client's two threads hand to each other: policies to the caller's loop, rollouts to the service."""

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from daedalus.actor.collecting.client_rows import ClientRows
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.lessons import LessonPlan
from daedalus.protocol.uploads import Rollout


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
