"""Confirmation of a target that was reached: the learner waits while its launcher plays new episodes."""

import logging
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from daedalus.learner.run.confirmation_file import ConfirmationFile
from daedalus.learner.serving.run_context import RunContext
from daedalus.protocol.texts import exact_number, short_number

if TYPE_CHECKING:
    from daedalus.learner.training.checkpointer import Checkpointer

_POLL_SECONDS = 0.05

_logger = logging.getLogger(__name__)


class TargetConfirmation:
    """The new episodes of one run, from the learner's side."""

    def __init__(self, context: RunContext, beat: Callable[[], None]) -> None:
        """Construct the confirmation.

        Args:
          context: the run; its newest returns are forgotten when the target is not confirmed.
          beat: called again and again during the wait, to show that this process works.
        """
        self._context, self._file, self._beat = context, ConfirmationFile(context.directory), beat
        self._not_before = -math.inf  # of the next attempt, on the monotonic clock
        self.result: dict[str, Any] | None = None  # of the new episodes that confirmed the target

    def confirm(self, policy_version: int, checkpointer: "Checkpointer") -> bool:
        """Wait until the launcher has played new episodes with the present policy, and return whether they confirm it.

        If they do not, the newest returns are forgotten: the target has to be reached again, and training goes on for
        at least as long as the attempt has lasted: attempts take at most half of the time. Until then, nothing is
        played. If the episodes cannot be played, or nothing can be written to the disk, the target counts as reached
        without them.
        """
        began = time.monotonic()
        if began < self._not_before:
            return False
        if not checkpointer.wait(checkpointer.begin(), self._beat, patient=False):
            return not self._context.stop.is_set()  # when a stopped run is resumed, it asks again
        training = self._context.spec.training
        episodes = f"{training.target_episodes} new episodes"
        target = exact_number(training.target_return)
        text = f"target {target} reached: the policy of this moment plays {episodes} to confirm it"
        self._context.events.add("target", text, cause=f"version {policy_version}")
        try:
            result = self._played_with(policy_version)
        except OSError as error:
            _logger.warning("the target cannot be confirmed: %s", error.strerror)
            return True
        if result is None:  # the run is stopped; when it is resumed, it asks again
            return False
        if "failed" in result:  # such as a simulator of which only one runs at a time
            text = f"the target cannot be confirmed: {result['failed']}"
            self._context.events.add("target", text, cause=f"result of version {policy_version}")
            return True
        if result["confirmed"]:
            self.result = result
            return True
        with self._context.lock:
            self._context.counters.forget_returns()
        ended = time.monotonic()
        self._not_before = ended + (ended - began)
        text = f"not confirmed: return {short_number(result['return_mean'])}; training continues"
        self._context.events.add("target", text, cause=f"result of version {policy_version}")
        return False

    def _played_with(self, policy_version: int) -> dict[str, Any] | None:
        """Return the launcher's result, or None if the run is stopped first. Raises OSError."""
        try:
            self._file.ask(policy_version)
            while (result := self._file.answered(policy_version)) is None and not self._context.stop.wait(
                _POLL_SECONDS
            ):
                self._beat()
                self._context.health.updated = time.monotonic()  # it works, although it does not train
            return result
        finally:
            self._file.clear()
