"""Compact snapshots for actors on slow links: weights in bfloat16, as differences to the version that an actor holds.

A compact snapshot is sent in parts. State, no I/O and no threads. Encoding is slow, so the transport's threads must not
call this file.
"""

from dataclasses import dataclass

import numpy as np

from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import Bits, bfloat16, planes
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import CompactSnapshot, Refusal, Snapshot, SnapshotPart, SnapshotRequest

# A part waits in the router until the reader's link is free. A part larger than the router's buffer for one reader
# would block the learner's messages to all other readers.
PART_BYTES = 32 << 10
_HELD_BYTES = 64 << 20  # of versions that can be the base of a difference
_MAX_READERS = 256  # actors that fetch a snapshot at the same time
_LARGE_DIFFERENCE = 1.3  # bytes per weight; above it, the whole snapshot may be smaller than the difference


@dataclass(frozen=True, slots=True)
class _Prepared:
    """Encoded CompactSnapshot, before it is split into parts."""

    version: int
    base: int | None
    encoded: bytes


class CompactSnapshotCache:
    """Cache of compact snapshots during one learner epoch. Answers SnapshotRequests."""

    def __init__(self, learner_epoch: int) -> None:
        self._epoch = learner_epoch
        self._held: dict[int, Bits] = {}  # by version, the most recently requested version last
        self._prepared: dict[str, _Prepared] = {}  # by actor, the most recent request last

    def answer(self, request: SnapshotRequest, newest: bytes) -> bytes:
        """Return the encoded SnapshotPart that `request` names, or a Refusal.

        Args:
          request: names the part, and the version that the actor holds.
          newest: the newest encoded Snapshot, or the message that is sent in its place.
        """
        if request.policy_version is None:
            snapshot = decode(newest, Limits(max_bytes=len(newest)))
            if not isinstance(snapshot, Snapshot):
                return newest
            self._prepared.pop(request.actor, None)
            while len(self._prepared) >= _MAX_READERS:
                del self._prepared[next(iter(self._prepared))]
            self._prepared[request.actor] = self._prepare(snapshot, request.held_version)
        prepared = self._prepared.get(request.actor)
        if prepared is None or request.policy_version not in (None, prepared.version):
            return encode(Refusal(code="unknown", reason="the snapshot is no longer available: request the newest"))
        parts = -(-len(prepared.encoded) // PART_BYTES)
        if request.part >= parts:
            return encode(
                Refusal(code="unknown", reason=f"part {request.part} does not exist: the snapshot has {parts} parts")
            )
        piece = prepared.encoded[request.part * PART_BYTES : (request.part + 1) * PART_BYTES]
        return encode(
            SnapshotPart(
                learner_epoch=self._epoch,
                policy_version=prepared.version,
                part=request.part,
                parts=parts,
                data=np.frombuffer(piece, np.uint8),
            )
        )

    def _prepare(self, snapshot: Snapshot, held: int | None) -> _Prepared:
        """Return the encoded snapshot, from the cache if another actor requested the same difference."""
        version = snapshot.policy_version
        base = self._held.get(held) if held is not None else None
        held = None if base is None else held
        for prepared in self._prepared.values():
            if (prepared.version, prepared.base) == (version, held):
                return prepared
        bits = self._held.pop(version, None) or bfloat16(snapshot.weights)
        encoded = _encoded(snapshot, bits, held, base)
        count = sum(array.size for array in bits.values())
        if base is not None and len(encoded) > _LARGE_DIFFERENCE * count:
            whole = _encoded(snapshot, bits, None, None)
            if len(whole) < len(encoded):
                encoded = whole
        self._hold(version, bits)
        return _Prepared(version, held, encoded)

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
