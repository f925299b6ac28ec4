"""The choice of actions for all clients that wait, in one call of the policy. For the gateway's event loop."""

import asyncio
import logging
from collections.abc import Callable

import numpy as np

from daedalus.actor.collecting.rollout_writer import RowInputs
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.policy_versions import PolicyVersion
from daedalus.policy.acting.noise import joined_noise
from daedalus.policy.acting.runtime import Choice, PolicyError

_logger = logging.getLogger(__name__)

_MAX_ROWS = 64  # in one call: the event loop waits for it
_PAUSE_SECONDS = 0.001  # between calls: a call for four clients costs little more than a call for one


class Batcher:
    """The clients that wait for an action.

    The event loop reads what all clients sent before it calls `_choose_all`: the busier the gateway, the larger the
    batches. A client waits for others only while the calls follow each other closely, and not if all wait already.
    """

    def __init__(
        self,
        current: Callable[[], PolicyVersion],
        clients: Callable[[], int],
        on_failure: Callable[[PolicyError], None],
        on_fault: Callable[[ClientActor, Exception], None],
    ) -> None:
        """Construct the batcher in a running event loop.

        Args:
          current: returns the newest version; called when a client waits.
          clients: returns the number of clients.
          on_failure: called if the policy does not run.
          on_fault: called with an actor that cannot take its action; the others have theirs.
        """
        self._current, self._clients, self._on_failure, self._on_fault = current, clients, on_failure, on_fault
        self._loop = asyncio.get_running_loop()
        self._waiting: dict[ClientActor, None] = {}
        self._next_call: asyncio.Handle | None = None
        self._pause_ends = 0.0  # by the loop's clock

    def add(self, actor: ClientActor) -> None:
        """Choose for an actor that has observed, soon."""
        self._waiting[actor] = None
        if self._next_call is None:
            self._next_call = self._loop.call_at(self._pause_ends, self._choose_all)
        if len(self._waiting) >= self._clients():
            self._next_call.cancel()
            self._next_call = self._loop.call_soon(self._choose_all)

    def remove(self, actor: ClientActor) -> None:
        """Do not choose for an actor any more."""
        self._waiting.pop(actor, None)

    def _choose_all(self) -> None:
        self._next_call, self._pause_ends = None, self._loop.time() + _PAUSE_SECONDS
        waiting, self._waiting = self._waiting, {}
        if not waiting:
            return
        current = self._current()
        batches: dict[PolicyVersion, list[ClientActor]] = {}
        for actor in waiting:
            batches.setdefault(actor.select_version(current), []).append(actor)
        try:
            for version, actors in batches.items():
                for first in range(0, len(actors), _MAX_ROWS):
                    self._choose(version, actors[first : first + _MAX_ROWS])
        except PolicyError as error:
            self._on_failure(error)

    def _choose(self, version: PolicyVersion, actors: list[ClientActor]) -> None:
        inputs = _joined([actor.begin_row() for actor in actors])
        choice = version.runtime.act(inputs.observations, inputs.state, inputs.noise, inputs.masks, inputs.epsilon)
        for row, actor in enumerate(actors):
            actions = {name: values[row : row + 1] for name, values in choice.actions.items()}
            one = Choice(actions, choice.log_probs[row : row + 1], choice.state[row : row + 1])
            try:
                if not actor.take(one):
                    self.add(actor)
            except Exception as error:  # broad: whatever one client brings may not keep actions from the others
                _logger.exception("client %s cannot take its action", actor.name)
                self._on_fault(actor, error)


def _joined(inputs: list[RowInputs]) -> RowInputs:
    """Return the inputs of several clients, one row for each."""
    first = inputs[0]
    if len(inputs) == 1:
        return first
    return RowInputs(
        {name: np.concatenate([each.observations[name] for each in inputs]) for name in first.observations},
        np.concatenate([each.state for each in inputs]),
        {name: np.concatenate([each.masks[name] for each in inputs]) for name in first.masks},
        np.concatenate([each.epsilon for each in inputs]),
        joined_noise([each.noise for each in inputs]),
    )
