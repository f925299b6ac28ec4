"""What actors on slow links are answered: the newest weights in bfloat16, as differences to those that they hold, in
parts. State, no I/O and no threads; it takes its time, so the transport's threads do not call it.
"""

from dataclasses import dataclass

import numpy as np

from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import Bits, bfloat16, planes
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import CompactSnapshot, Refusal, Snapshot, SnapshotPart, SnapshotRequest

# A part waits in the router for its reader's link. What is larger than a router's buffers for one reader would, while
# it waits for room in them, hold up all that its sender has for others.
PART_BYTES = 32 << 10
_HELD_BYTES = 64 << 20  # of versions that differences may be to
_MOST_READERS = 256  # at once
_WORTH_COMPARING = 1.3  # bytes a weight, beyond which differences may be larger than what they are made of


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A CompactSnapshot, ready to be cut."""

    version: int
    base: int | None
    encoded: bytes


class CompactSnapshotCache:
    """Answers SnapshotRequests in one life of a learner."""

    def __init__(self, learner_epoch: int) -> None:
        self._epoch = learner_epoch
        self._held: dict[int, Bits] = {}  # by version, the one that was asked for last at the end
        self._prepared: dict[str, _Prepared] = {}  # by actor, likewise

    def answer(self, request: SnapshotRequest, newest: bytes) -> bytes:
        """The part that was asked for; `newest` is the encoded snapshot, or what is answered in place of one."""
        if request.policy_version is None:
            snapshot = decode(newest, Limits(max_bytes=len(newest)))
            if not isinstance(snapshot, Snapshot):
                return newest
            self._prepared.pop(request.actor, None)
            while len(self._prepared) >= _MOST_READERS:
                del self._prepared[next(iter(self._prepared))]
            self._prepared[request.actor] = self._prepare(snapshot, request.held_version)
        prepared = self._prepared.get(request.actor)
        if prepared is None or request.policy_version not in (None, prepared.version):
            return encode(Refusal(code="unknown", reason="that snapshot is gone: ask for the newest"))
        parts = -(-len(prepared.encoded) // PART_BYTES)
        if request.part >= parts:
            return encode(Refusal(code="unknown", reason=f"there are {parts} parts, no part {request.part}"))
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
        """Encodes the snapshot, unless it was encoded for somebody who holds the same."""
        version = snapshot.policy_version
        base = self._held.get(held) if held is not None else None
        held = None if base is None else held
        for prepared in self._prepared.values():
            if (prepared.version, prepared.base) == (version, held):
                return prepared
        bits = self._held.pop(version, None) or bfloat16(snapshot.weights)
        encoded = _encoded(snapshot, bits, held, base)
        count = sum(array.size for array in bits.values())
        if base is not None and len(encoded) > _WORTH_COMPARING * count:
            whole = _encoded(snapshot, bits, None, None)
            if len(whole) < len(encoded):
                encoded = whole
        self._hold(version, bits)
        return _Prepared(version, held, encoded)

    def _hold(self, version: int, bits: Bits) -> None:
        """Keeps a version for later differences; those that were asked for longest ago give way."""
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
