"""What actors are given to play with: the program, and snapshots, which are pushed, asked for, or fetched small."""

import contextlib
from collections.abc import Callable

import numpy as np

from daedalus.learner.serving.compact_snapshot_server import CompactSnapshotServer
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.query_responses import QueryResponses
from daedalus.policy.acting.runtime import program_hash
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Program, RunEnded, Snapshot
from daedalus.protocol.spec import RunSpec
from daedalus.transport.interface import Request, Transport, TransportError


class Publisher:
    """One life of a learner's. Publishing is for one thread, answering for any; `fleet` is read under its lock."""

    def __init__(
        self,
        run: str,
        spec: RunSpec,
        learner_epoch: int,
        start_version: int,
        transport: Transport,
        responses: QueryResponses,
        fleet: Fleet,
        on_small_answer: Callable[[str, int], None],
    ) -> None:
        """`on_small_answer` is told which actor on a slow link was sent how many bytes."""
        self._key, self._spec, self._epoch = keys.snapshots(run), spec, learner_epoch
        self._transport, self._responses, self._fleet = transport, responses, fleet
        self._compact_snapshots = CompactSnapshotServer(learner_epoch, responses.snapshot, on_small_answer)
        self._unpublished = 0  # rollouts that were learned from since
        self.program_hash = ""  # empty before there is one
        self.version = start_version  # the newest that actors can have

    def open(self) -> None:
        """Starts to answer."""
        self._compact_snapshots.open()

    def close(self, reason: str) -> None:
        """Says run_ended in place of snapshots."""
        run_ended = encode(RunEnded(learner_epoch=self._epoch, reason=reason))
        self._responses.close(run_ended)
        self._push(run_ended)
        self._compact_snapshots.close()

    def answer(self, request: Request) -> None:
        """Answers a query on `snapshots`, now or soon. Never waits."""
        if request.size:
            self._compact_snapshots.offer(request)
        else:
            request.reply(self._responses.snapshot())

    def offer_program(self, model: bytes) -> None:
        """Has the policy program ready for those who ask."""
        self.program_hash = program_hash(model)
        self._responses.offer_program(Program(hash=self.program_hash, model=np.frombuffer(model, np.uint8)))

    def is_due(self, policy_version: int, rollouts: int, live: int) -> bool:
        """Whether to publish a version that was made of so many rollouts, while so many actors take part.

        An actor takes one snapshot a rollout. Of a small fleet each update is published; a large one has it in vain
        before a quarter of it has had its turn, and pays for it: a thousand actors get a thousand copies. What is
        played must stay well within the policy lag that is learned from, though.
        """
        self._unpublished += rollouts
        ages = 4 * (policy_version - self.version) >= self._spec.training.policy_lag_bound
        return self._spec.algorithm.synchronous or ages or 4 * self._unpublished >= live

    def publish(self, policy_version: int, weights: dict[str, np.ndarray]) -> None:
        """Encodes a snapshot once, for those who follow and for those who ask."""
        snapshot = encode(
            Snapshot(
                learner_epoch=self._epoch,
                policy_version=policy_version,
                program=self.program_hash,
                weights=weights,
            )
        )
        self._responses.offer_snapshot(snapshot)
        self.version, self._unpublished = policy_version, 0
        self._push(snapshot)
        self._fleet.pushed_bytes += len(snapshot)

    def _push(self, news: bytes) -> None:
        with contextlib.suppress(TransportError):  # in a session that is being replaced: who needs it asks for it
            self._transport.publish(self._key, news)
