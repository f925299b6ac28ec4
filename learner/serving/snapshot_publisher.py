"""Publication of the program and of snapshots, by push, by query, and as compact snapshots."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.serving.waiting_requests import read_request
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import Bits, bfloat16, planes
from daedalus.protocol.lessons import LessonPlan
from daedalus.protocol.limits import SNAPSHOT_REQUEST_LIMITS, Limits
from daedalus.protocol.messages import (
    CompactSnapshot,
    LeagueRequest,
    Program,
    Refusal,
    Snapshot,
    SnapshotPart,
    SnapshotRequest,
)
from daedalus.transport.interface import Request, Transport, TransportError

# A part waits in the router until the reader's link is free. A part larger than the router's buffer for one reader
# would block the learner's messages to all other readers.
PART_BYTES = 32 << 10
_HELD_BYTES = 64 << 20  # of versions that can be the base of a difference
# Encoded snapshots are kept for the fetches in progress.
_PREPARED_BYTES = 256 << 20
_MAX_PREPARED = 1024  # held versions that actors name: those that are not held here share one whole snapshot
_FORGET_SECONDS = 120.0  # after the last request; an actor that still fetches asks within 60 s
_LARGE_DIFFERENCE = 1.3  # bytes per weight; above it, the whole snapshot may be smaller than the difference


@dataclass(slots=True)
class _Prepared:
    """Encoded CompactSnapshot, before it is split into parts."""

    base: int | None  # the version that the differences refer to; None: no differences
    encoded: bytes
    requested_at: float  # on the monotonic clock, in seconds


class CompactSnapshotCache:
    """Cache of compact snapshots during one learner epoch. Answers SnapshotRequests."""

    def __init__(self, learner_epoch: int) -> None:
        self._epoch = learner_epoch
        self._held: dict[int, Bits] = {}  # by version, the most recently requested version last
        # By the version of the snapshot and the held version that was requested; the most recent request last.
        self._prepared: dict[tuple[int, int | None], _Prepared] = {}

    def answer(self, request: SnapshotRequest, newest: bytes) -> bytes:
        """Return the encoded SnapshotPart that `request` names, or a Refusal.

        Args:
          request: names the part, and the version that the actor holds.
          newest: the newest encoded Snapshot, or the message that is sent in its place.
        """
        version, held = request.policy_version, request.held_version
        if version is None:
            snapshot = decode(newest, Limits(max_bytes=len(newest)))
            if not isinstance(snapshot, Snapshot):
                return newest
            version = snapshot.policy_version
            if (version, held) not in self._prepared:
                self._prepared[version, held] = self._prepare(snapshot, held)
                self._make_room()
        prepared = self._prepared.pop((version, held), None)
        if prepared is None:
            return _refusal("unknown", "the snapshot is no longer available: request the newest")
        self._prepared[version, held] = prepared
        prepared.requested_at = time.monotonic()
        parts = -(-len(prepared.encoded) // PART_BYTES)
        if request.part >= parts:
            return _refusal("unknown", f"part {request.part} does not exist: the snapshot has {parts} parts")
        piece = prepared.encoded[request.part * PART_BYTES : (request.part + 1) * PART_BYTES]
        return encode(
            SnapshotPart(
                learner_epoch=self._epoch,
                policy_version=version,
                part=request.part,
                parts=parts,
                data=np.frombuffer(piece, np.uint8),
            )
        )

    def _prepare(self, snapshot: Snapshot, held: int | None) -> _Prepared:
        """Return the encoded snapshot: the whole one if `held` is no version to which a difference can be computed."""
        version = snapshot.policy_version
        base = self._held.get(held) if held is not None else None
        held = None if base is None else held
        for (prepared_version, _), prepared in self._prepared.items():
            if (prepared_version, prepared.base) == (version, held):
                return replace(prepared)  # of the same bytes
        bits = self._held.pop(version, None) or bfloat16(snapshot.weights)
        encoded = _encoded(snapshot, bits, held, base)
        count = sum(array.size for array in bits.values())
        if base is not None and len(encoded) > _LARGE_DIFFERENCE * count:
            whole = _encoded(snapshot, bits, None, None)
            if len(whole) < len(encoded):
                encoded = whole
        self._hold(version, bits)
        return _Prepared(held, encoded, time.monotonic())

    def _make_room(self) -> None:
        """Drop the encoded snapshots that were not requested for longest, but never the newest."""
        now = time.monotonic()
        while len(self._prepared) > 1:
            key, oldest = next(iter(self._prepared.items()))
            is_current = now - oldest.requested_at <= _FORGET_SECONDS
            if is_current and len(self._prepared) <= _MAX_PREPARED and self._prepared_bytes <= _PREPARED_BYTES:
                break
            del self._prepared[key]

    @property
    def _prepared_bytes(self) -> int:
        """Size of the encoded snapshots; those that several held versions share count once."""
        return sum({id(each.encoded): len(each.encoded) for each in self._prepared.values()}.values())

    def _hold(self, version: int, bits: Bits) -> None:
        """Keep a version as the base of later differences. At capacity, drop the least recently requested version."""
        self._held[version] = bits
        each = sum(array.nbytes for array in bits.values())
        while len(self._held) > max(_HELD_BYTES // max(each, 1), 2):
            del self._held[next(iter(self._held))]


def _encoded(snapshot: Snapshot, bits: Bits, held: int | None, base: Bits | None) -> bytes:
    return encode(
        CompactSnapshot(
            learner_epoch=snapshot.learner_epoch,
            policy_version=snapshot.policy_version,
            program=snapshot.program,
            base_version=held,
            weights=planes(bits, base),
            lessons=snapshot.lessons,
        )
    )


_MAX_WAITING = 4096  # requests, of at most a kilobyte each
_CLOSE_SECONDS = 0.5  # for an answer in progress; a frozen reader must not delay the shutdown further


class CompactSnapshotServer:
    """Server of requests whose answers take time, from `open` to `close`: compact snapshots, policies of opponents."""

    def __init__(
        self,
        learner_epoch: int,
        newest: Callable[[], bytes],
        of_player: Callable[[str], bytes],
        on_answer: Callable[[SnapshotRequest | LeagueRequest, int], None],
    ) -> None:
        """Construct the server.

        Args:
          learner_epoch: epoch of this learner process.
          newest: function that returns the newest encoded snapshot.
          of_player: function that returns the answer to a request for the policy of a player of the league.
          on_answer: called with the request and the number of bytes after each answer.
        """
        self._cache = CompactSnapshotCache(learner_epoch)
        self._newest, self._of_player, self._on_answer = newest, of_player, on_answer
        self._requests: queue.SimpleQueue[tuple[Request, SnapshotRequest | LeagueRequest] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="compact snapshots", daemon=True)

    def open(self) -> None:
        """Start the thread."""
        self._thread.start()

    def offer(self, request: Request, message: SnapshotRequest | LeagueRequest) -> None:
        """Queue a request and its decoded payload, or refuse it if the queue is full. Does not block."""
        if self._requests.qsize() >= _MAX_WAITING:
            request.reply(_refusal("not_ready", "too many requests for snapshots: retry later"))
        else:
            self._requests.put((request, message))

    def close(self) -> None:
        """Answer the waiting requests, and stop the thread."""
        self._requests.put(None)
        if self._thread.is_alive():
            self._thread.join(timeout=_CLOSE_SECONDS)

    def _work(self) -> None:
        while (waiting := self._requests.get()) is not None:
            request, message = waiting
            if isinstance(message, LeagueRequest):
                answer = self._of_player(message.player)
            else:
                answer = self._cache.answer(message, self._newest())
            request.reply(answer)
            self._on_answer(message, len(answer))


class SnapshotPublisher:
    """Publisher of the program and snapshots during one learner epoch.

    One thread publishes; any thread may answer queries.
    """

    def __init__(self, context: RunContext, transport: Transport) -> None:
        self._context, self._transport = context, transport
        self._league = context.league
        self._compact = CompactSnapshotServer(context.learner_epoch, self.snapshot, self._of_player, self._count_answer)
        # The answer to queries for the newest snapshot, and its version if it is a snapshot.
        self._snapshot: tuple[bytes, int | None] = (_refusal("not_ready", "the learner has no policy yet"), None)
        self._unchanged = _refusal("not_ready", "the actor holds the newest snapshot")
        self.offered: Program | None = None
        self._program = b""  # encoded
        self._ended = False
        self._unpublished_rollouts = 0  # trained on since the last snapshot
        self.version = context.start_version  # the newest published version
        self.extras: Callable[[], dict[str, np.ndarray]] = dict  # what snapshots carry besides the weights
        spec = context.spec
        on_gpu = spec.training.device == "cuda" and not (spec.algorithm.synchronous or spec.uploads_gradients)
        self._background = ThreadPoolExecutor(1, thread_name_prefix="snapshots") if on_gpu else None
        self._publication: Future[None] = Future()  # the newest in the background
        self._publication.set_result(None)

    def open(self) -> None:
        """Start to answer requests for compact snapshots."""
        self._compact.open()

    def end(self, run_ended: bytes) -> None:
        """Answer queries for snapshots with `run_ended`, an encoded RunEnded, from now on."""
        self._ended = True
        wait([self._publication], _CLOSE_SECONDS)
        self._snapshot = run_ended, None

    def close(self) -> None:
        """Stop to answer requests for compact snapshots."""
        self._compact.close()
        if self._background is not None:
            self._background.shutdown(wait=False, cancel_futures=True)

    def program(self, name: str) -> bytes:
        """Return the answer to a query for the program with a hash, or for the current program (`*`)."""
        if self.offered is None or name not in ("*", self.offered.hash):
            if self._league is not None and (program := self._league.program(name)) is not None:
                return program
            return _refusal("unknown", f"no program with hash {name[:64]!r}")
        return self._program

    def snapshot(self, held_version: int | None = None) -> bytes:
        """Return the answer to a query for the newest snapshot by an actor that holds `held_version`."""
        encoded, version = self._snapshot
        return self._unchanged if version is not None and version == held_version else encoded

    def answer(self, request: Request) -> None:
        """Answer a query on `snapshots`, or queue it if it requests a compact snapshot. Does not block."""
        if not request.size:
            request.reply(self.snapshot())
            return
        message = read_request(request.payload, SNAPSHOT_REQUEST_LIMITS, SnapshotRequest, LeagueRequest)
        if isinstance(message, Refusal):
            request.reply(encode(message))
        elif isinstance(message, LeagueRequest) and not message.player:
            request.reply(self._plan(message))
        elif isinstance(message, LeagueRequest) or message.compact:
            self._compact.offer(request, message)
        else:
            answer = self.snapshot(message.held_version)
            request.reply(answer)
            self._count_answer(message, len(answer))

    def offer_program(self, model: bytes) -> None:
        """Make the policy program available to queries."""
        self.offered = Program.of(model)
        self._program = encode(self.offered)

    def publish_if_due(
        self, policy_version: int, begin_weights: Callable[[], Callable[[], dict[str, np.ndarray]]], rollouts: int
    ) -> None:
        """Publish a policy version if enough rollouts were trained on since the last snapshot.

        With a small fleet, publish every update. With a large fleet, publish after a quarter of the actors have
        contributed: each snapshot is copied and encoded, and an actor uses at most one for each rollout.
        Publish in any case after a quarter of the policy lag bound, so that rollouts stay well within the bound.

        With a GPU a thread of its own waits for the weights, encodes and publishes them, while updates go on. Versions
        that are due meanwhile are left out.

        Args:
          policy_version: the version of the weights.
          begin_weights: begins to copy the weights, and returns what returns the numpy arrays by parameter name: with a
            large fleet, few versions are published.
          rollouts: number of rollouts in the batch that made the version.
        """
        self._unpublished_rollouts += rollouts
        with self._context.lock:
            live = len(self._context.fleet.live)
        version_due = 4 * (policy_version - self.version) >= self._context.spec.policy_lag_bound_with(live)
        if self._context.spec.algorithm.synchronous or version_due or 4 * self._unpublished_rollouts >= live:
            if self._background is None:
                self.publish(policy_version, begin_weights()())
            elif self._publication.done():
                self._publication.result()  # a fault of that thread ends this one
                self._unpublished_rollouts = 0
                lessons = self._context.lessons.plan(self._context.counters.env_steps)
                weights = begin_weights()
                self._publication = self._background.submit(lambda: self._send(policy_version, weights(), lessons))

    def publish(self, policy_version: int, weights: dict[str, np.ndarray]) -> None:
        """Publish a snapshot. It is encoded once, for subscribers and for queries."""
        self._publication.result()  # of an earlier version
        self._unpublished_rollouts = 0
        lessons = self._context.lessons.plan(self._context.counters.env_steps)
        self._send(policy_version, {**weights, **self.extras()}, lessons)

    def _send(self, policy_version: int, weights: dict[str, np.ndarray], lessons: LessonPlan | None) -> None:
        snapshot = encode(
            Snapshot(
                learner_epoch=self._context.learner_epoch,
                policy_version=policy_version,
                program=self.offered.hash if self.offered else "",
                weights=weights,
                lessons=lessons,
            )
        )
        if not self._ended:
            self._snapshot = snapshot, policy_version
        self.version = policy_version
        with contextlib.suppress(TransportError):  # the session is being replaced; actors query a missed snapshot
            self._transport.publish(keys.snapshots(self._context.name), snapshot)
        self._context.fleet.pushed_bytes += len(snapshot)
        self._context.counters.snapshots_published += 1

    def _plan(self, request: LeagueRequest) -> bytes:
        """Return the answer to a request for whom to play."""
        if self._league is None:
            return _refusal("unknown", "the run plays no game with several agents")
        with self._context.lock:
            has_joined = request.actor in self._context.fleet.actors
        if not has_joined:  # the first request of an actor begins the league
            return _refusal("not_ready", "join the run first")
        return self.snapshot() if self._ended else self._league.plan(request.held_revision)

    def _of_player(self, player: str) -> bytes:
        """Return the answer to a request for the policy of a player."""
        if self._league is None:
            return _refusal("unknown", "the run plays no game with several agents")
        if self._ended or self.offered is None:
            return self.snapshot()  # why there is none
        return self._league.snapshot(player, self.offered.hash)

    def _count_answer(self, request: SnapshotRequest | LeagueRequest, size: int) -> None:
        """Count an answer to an actor. Any thread may call this method."""
        with self._context.lock:
            actor = self._context.fleet.actors.get(request.actor)
            if actor is not None:
                if isinstance(request, SnapshotRequest):
                    actor.fetches, actor.compact_snapshots = True, request.compact
                actor.answered_bytes += size


def _refusal(code: Literal["not_ready", "unknown"], reason: str) -> bytes:
    return encode(Refusal(code=code, reason=reason))
