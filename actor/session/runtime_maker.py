"""The runtime of the policy for a session. The time that the learner's program takes to come measures the link."""

import logging
import threading
import time

from daedalus.actor.errors import ActorError
from daedalus.actor.session.config import ActorConfig
from daedalus.actor.session.learner_queries import LearnerQueries
from daedalus.actor.session.run_end import RunEndWatch
from daedalus.actor.session.session_monitor import SessionMonitor
from daedalus.actor.session.snapshot_feed import SnapshotFeed
from daedalus.actor.session.snapshot_source import FIRST_PUSH_SECONDS, MISSED_PUSH_SECONDS
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.protocol.messages import Welcome
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import UnsupportedRunError

_logger = logging.getLogger(__name__)

_SLOW_LINK_SECONDS, _SLOW_LINK_RATE = 0.1, 1 << 20  # a link is slow beyond this latency and so many bytes a second


class RuntimeMaker:
    """Makes the runtime of an actor's policy in each session with a learner."""

    def __init__(
        self,
        config: ActorConfig,
        queries: LearnerQueries,
        feed: SnapshotFeed,
        monitor: SessionMonitor,
        end: RunEndWatch,
        stop: threading.Event,
    ) -> None:
        self._config, self._queries, self._feed = config, queries, feed
        self._monitor, self._end, self._stop = monitor, end, stop

    def make(self, welcome: Welcome, spaces: Spaces, environments: int) -> PolicyRuntime:
        """Return the runtime for a number of environments. Waits for the program of the learner, unless torch is used.

        If the program comes slowly, and the actor may choose, the feed uses compact snapshots from now on.
        """
        if self._config.runtime == "torch":
            from daedalus.policy.acting.torch_runtime import TorchRuntime  # the only part of an actor with torch

            try:
                learning = welcome.spec.learning_settings
            except UnsupportedRunError as error:
                raise ActorError(str(error)) from None
            return TorchRuntime(learning.policy, spaces, learning.training)
        rows = environments * welcome.spec.collection.rollout_length  # a rollout is played with one snapshot
        return OnnxRuntime(self._await_program(welcome), self._stop, rows)

    def _await_program(self, welcome: Welcome) -> bytes:
        """Return the program once the learner has it; measure the link by the time that it takes."""
        pause = FIRST_PUSH_SECONDS
        while True:
            began = time.monotonic()
            program = self._queries.program(welcome.run)
            if program is not None:
                break
            self._feed.subscribe()  # nothing is pushed yet: the first snapshot says that the program is there too
            self._monitor.wait_for_message(pause)
            self._feed.read()
            pause = min(2 * pause, MISSED_PUSH_SECONDS)
        if self._config.link == "auto" and not welcome.spec.algorithm.synchronous:
            self._measure_link(welcome, time.monotonic() - began, len(program[1]))
        return program[1]

    def _measure_link(self, welcome: Welcome, seconds: float, size: int) -> None:
        """Use compact snapshots if the program takes long again and again: once may be a busy machine."""
        allowed = _SLOW_LINK_SECONDS + size / _SLOW_LINK_RATE
        for _ in range(2):
            if seconds <= allowed:
                return
            self._end.check()  # a request may take 5 s
            began = time.monotonic()
            self._queries.program(welcome.run)
            seconds = time.monotonic() - began
        if seconds > allowed:
            _logger.info(
                "slow link: %s bytes took %.2f s; fetching compact snapshots as often as it allows",
                f"{size:,}",
                seconds,
            )
            self._feed.use_compact_snapshots()
