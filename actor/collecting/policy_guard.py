"""Decides whether a client's policy may act, and what is played in its place. State without threads or I/O."""

import copy
import logging
from typing import Any

import gymnasium

from daedalus.actor.environments.components import batch_of_one, only_of_batch

_logger = logging.getLogger(__name__)

DEFAULT_MAX_AGE = 30.0  # seconds


class PolicyGuard:
    """The safe action of a client, and the reasons to play it. For one thread."""

    def __init__(
        self, action_space: gymnasium.Space, safe_action: Any, max_policy_age: float | None, *, untrained: bool
    ) -> None:
        """Construct the guard.

        Args:
          action_space: of the client's loop.
          safe_action: an action of that space, or a function that returns one for an observation; None: the policy
            always acts.
          max_policy_age: seconds since the learner was last known to have no newer policy; None: 30.
          untrained: whether a policy may act that no update has changed (policy version 0).

        Raises ValueError if the settings contradict each other, or the safe action is not of the space.
        """
        if safe_action is None and (max_policy_age is not None or untrained):
            raise ValueError("max_policy_age and untrained say when the safe action is played: pass a safe_action too")
        if max_policy_age is not None and not max_policy_age > 0.0:
            raise ValueError(f"max_policy_age is {max_policy_age}: it must be above 0 seconds")
        if safe_action is not None and not callable(safe_action):
            safe_action = _as_action(action_space, safe_action)
        self._action = safe_action
        self._untrained = untrained
        self.max_age = DEFAULT_MAX_AGE if max_policy_age is None else max_policy_age
        self.reason = ""  # why the safe action is played now; empty while the policy acts

    @property
    def enabled(self) -> bool:
        """Whether there is a safe action."""
        return self._action is not None

    def allows(self, policy_version: int, age: float) -> bool:
        """Return whether a policy may act; log when this changes. `age` is in seconds."""
        reason = self._reason(policy_version, age) if self.enabled else ""
        if reason != self.reason:
            if reason:
                _logger.warning("playing the safe action: %s", reason)
            else:
                _logger.warning("the policy acts again: version %d", policy_version)
            self.reason = reason
        return not reason

    def action(self, observation: Any) -> Any:
        """Return the safe action for an observation: a copy, because a loop may scale the action that it got."""
        return self._action(observation) if callable(self._action) else copy.deepcopy(self._action)

    def _reason(self, policy_version: int, age: float) -> str:
        if age > self.max_age:
            return f"the learner did not confirm the policy within {self.max_age:g} s"
        if policy_version == 0 and not self._untrained:
            return "no update has changed the policy yet: pass untrained=True to let it act"
        return ""


def _as_action(action_space: gymnasium.Space, action: Any) -> Any:
    """Return an action as the space has it: a copy, in its dtype. Raises ValueError if it is not in the space."""
    converted = only_of_batch(action_space, batch_of_one(action_space, action, "safe_action"))
    if not action_space.contains(converted):
        raise ValueError(f"safe_action {action!r} is not in the action space {action_space}")
    return converted
