"""Publication of the program and of snapshots, by push, by query, and as compact snapshots."""

import contextlib
import threading
from collections.abc import Callable

import numpy as np

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.compact_snapshot_server import CompactSnapshotServer
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.query_responses import QueryResponses
from daedalus.learner.serving.requests import read_request
from daedalus.policy.acting.runtime import program_hash
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import SNAPSHOT_REQUEST_LIMITS
from daedalus.protocol.messages import Program, Refusal, Snapshot, SnapshotRequest
from daedalus.protocol.spec import RunSpec
from daedalus.transport.interface import Request, Transport, TransportError


class SnapshotPublisher:
    """Publisher of the program and snapshots during one learner epoch.

    One thread publishes; any thread may answer queries.
    """

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
        """Construct the publisher.

        Args:
          run: name of the run.
          spec: specification of the run.
          transport: the network.
          responses: answers to queries, updated with each snapshot.
          fleet: the actors; guarded by `lock`.
          lock: the condition shared with the actor server.
          counters: counters of the run.
          learner_epoch: epoch of this learner process.
          start_version: policy version of the checkpoint that the run continues from, else 0.
        """
        self._key, self._spec, self._epoch = keys.snapshots(run), spec, learner_epoch
        self._transport, self._responses, self._counters = transport, responses, counters
        self._fleet, self._lock = fleet, lock
        self._compact = CompactSnapshotServer(learner_epoch, responses.snapshot, self._count_answer)
        self._unpublished_rollouts = 0  # trained on since the last snapshot
        self._program_hash = ""
        self.version = start_version  # the newest published version
        self.extras: Callable[[], dict[str, np.ndarray]] = dict  # what snapshots carry besides the weights

    def open(self) -> None:
        """Start to answer requests for compact snapshots."""
        self._compact.open()

    def close(self) -> None:
        """Stop to answer requests for compact snapshots."""
        self._compact.close()

    def answer(self, request: Request) -> None:
        """Answer a query on `snapshots`, or queue it if it requests a compact snapshot. Does not block."""
        if not request.size:
            request.reply(self._responses.snapshot())
            return
        message = read_request(request.payload, SNAPSHOT_REQUEST_LIMITS, SnapshotRequest)
        if isinstance(message, Refusal):
            request.reply(encode(message))
        elif message.compact:
            self._compact.offer(request, message)
        else:
            answer = self._responses.snapshot(message.held_version)
            request.reply(answer)
            self._count_answer(message, len(answer))

    def offer_program(self, model: bytes) -> None:
        """Make the policy program available to queries."""
        self._program_hash = program_hash(model)
        self._responses.offer_program(Program(hash=self._program_hash, model=np.frombuffer(model, np.uint8)))

    def publish_if_due(self, policy_version: int, weights: Callable[[], dict[str, np.ndarray]], rollouts: int) -> None:
        """Publish a policy version if enough rollouts were trained on since the last snapshot.

        With a small fleet, publish every update. With a large fleet, publish after a quarter of the actors have
        contributed: each snapshot is copied and encoded, and an actor uses at most one for each rollout.
        Publish in any case after a quarter of the policy lag bound, so that rollouts stay well within the bound.

        Args:
          policy_version: the version of the weights.
          weights: returns the numpy arrays by parameter name: with a large fleet, few versions are published.
          rollouts: number of rollouts in the batch that made the version.
        """
        self._unpublished_rollouts += rollouts
        with self._lock:
            live = len(self._fleet.live)
        version_due = 4 * (policy_version - self.version) >= self._spec.policy_lag_bound_with(live)
        if self._spec.algorithm.synchronous or version_due or 4 * self._unpublished_rollouts >= live:
            self.publish(policy_version, weights())

    def publish(self, policy_version: int, weights: dict[str, np.ndarray]) -> None:
        """Publish a snapshot. It is encoded once, for subscribers and for queries."""
        snapshot = encode(
            Snapshot(
                learner_epoch=self._epoch,
                policy_version=policy_version,
                program=self._program_hash,
                weights={**weights, **self.extras()},
            )
        )
        self._responses.offer_snapshot(snapshot, policy_version)
        self.version, self._unpublished_rollouts = policy_version, 0
        self._push(snapshot)
        self._fleet.pushed_bytes += len(snapshot)
        self._counters.snapshots_published += 1

    def newest(self) -> bytes:
        """Return the newest published snapshot, encoded."""
        return self._responses.snapshot()

    def _push(self, payload: bytes) -> None:
        with contextlib.suppress(TransportError):  # the session is being replaced; actors query a missed snapshot
            self._transport.publish(self._key, payload)

    def _count_answer(self, request: SnapshotRequest, size: int) -> None:
        """Count an answer to an actor. Any thread may call this method."""
        with self._lock:
            actor = self._fleet.actors.get(request.actor)
            if actor is not None:
                actor.fetches, actor.compact_snapshots = True, request.compact
                actor.answered_bytes += size
