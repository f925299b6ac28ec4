"""Compact snapshots for actors that request them: weights in bfloat16, as differences to the version they hold.

A compact snapshot is sent in parts. Each request of a fetch gives the version that the actor holds, and all but the
first also the version of the snapshot: encoded snapshots are kept by these two, whoever asks. State, no I/O and no
threads. Encoding is slow, so the transport's threads must not call this file.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import Bits, bfloat16, planes
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import CompactSnapshot, Refusal, Snapshot, SnapshotPart, SnapshotRequest

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
            return encode(Refusal(code="unknown", reason="the snapshot is no longer available: request the newest"))
        self._prepared[version, held] = prepared
        prepared.requested_at = time.monotonic()
        parts = -(-len(prepared.encoded) // PART_BYTES)
        if request.part >= parts:
            return encode(
                Refusal(code="unknown", reason=f"part {request.part} does not exist: the snapshot has {parts} parts")
            )
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
        )
    )
