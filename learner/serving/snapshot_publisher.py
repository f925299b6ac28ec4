"""What actors play with: the program, and snapshots, which are pushed, asked for, or fetched in compact form."""

import contextlib
import threading

import numpy as np

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.compact_snapshot_server import CompactSnapshotServer
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.query_responses import QueryResponses
from daedalus.policy.acting.runtime import program_hash
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Program, RunEnded, Snapshot
from daedalus.protocol.spec import RunSpec
from daedalus.transport.interface import Request, Transport, TransportError


class SnapshotPublisher:
    """Publishes for one learner epoch. Publishing is for one thread, answering for any."""

    def __init__(
        self,
        run: str,
        spec: RunSpec,
        transport: Transport,
        responses: QueryResponses,
        fleet: Fleet,
        lock: threading.Condition,
        counters: RunCounters,
        *,
        learner_epoch: int,
        start_version: int,
    ) -> None:
        """`lock` guards the fleet."""
        self._key, self._spec, self._epoch = keys.snapshots(run), spec, learner_epoch
        self._transport, self._responses, self._counters = transport, responses, counters
        self._fleet, self._lock = fleet, lock
        self._compact = CompactSnapshotServer(learner_epoch, responses.snapshot, self._count_compact)
        self._unpublished_rollouts = 0  # learned from since the last snapshot
        self._program_hash = ""
        self.version = start_version  # the newest that actors can have

    def open(self) -> None:
        """Start to answer."""
        self._compact.open()

    def close(self, reason: str) -> None:
        """Tell actors that the run has ended, in place of snapshots."""
        ended = encode(RunEnded(learner_epoch=self._epoch, reason=reason))
        self._responses.close(ended)
        self._push(ended)
        self._compact.close()

    def answer(self, request: Request) -> None:
        """Answer a query on `snapshots`, now or soon. Never waits."""
        if request.size:
            self._compact.offer(request)
        else:
            request.reply(self._responses.snapshot())

    def offer_program(self, model: bytes) -> None:
        """Hold the policy program ready for those who ask."""
        self._program_hash = program_hash(model)
        self._responses.offer_program(Program(hash=self._program_hash, model=np.frombuffer(model, np.uint8)))

    def publish_if_due(self, policy_version: int, weights: dict[str, np.ndarray], rollouts: int) -> None:
        """Publish a version that was made of so many rollouts, if enough actors would play it.

        An actor takes one snapshot a rollout. In a small fleet every update is published. With a large fleet, publish
        after a quarter of the actors have contributed: each snapshot is sent to all of them. The versions that are
        played must stay well within the policy lag that is learned from.
        """
        self._unpublished_rollouts += rollouts
        with self._lock:
            live = len(self._fleet.live)
        ages = 4 * (policy_version - self.version) >= self._spec.training.policy_lag_bound
        if self._spec.algorithm.synchronous or ages or 4 * self._unpublished_rollouts >= live:
            self.publish(policy_version, weights)

    def publish(self, policy_version: int, weights: dict[str, np.ndarray]) -> None:
        """Encode a snapshot once, for subscribers and for queries."""
        snapshot = encode(
            Snapshot(
                learner_epoch=self._epoch,
                policy_version=policy_version,
                program=self._program_hash,
                weights=weights,
            )
        )
        self._responses.offer_snapshot(snapshot)
        self.version, self._unpublished_rollouts = policy_version, 0
        self._push(snapshot)
        self._fleet.pushed_bytes += len(snapshot)
        self._counters.snapshots_published += 1

    def newest(self) -> bytes:
        """Return the snapshot that was published last, encoded."""
        return self._responses.snapshot()

    def _push(self, payload: bytes) -> None:
        with contextlib.suppress(TransportError):  # the session is being replaced; actors ask for what they miss
            self._transport.publish(self._key, payload)

    def _count_compact(self, name: str, size: int) -> None:
        """Called on the compact snapshot server's thread."""
        with self._lock:
            actor = self._fleet.actors.get(name)
            if actor is not None:
                actor.compact_snapshots, actor.answered_bytes = True, actor.answered_bytes + size
