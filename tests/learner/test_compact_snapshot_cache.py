"""learner/serving/snapshot_publisher.py: compact snapshots for actors that request them."""

import numpy as np
import pytest

from daedalus.learner.serving import snapshot_publisher as compact_cache
from daedalus.learner.serving.snapshot_publisher import PART_BYTES, CompactSnapshotCache
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import bfloat16, bits_of, float32
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    CompactSnapshot,
    Message,
    Refusal,
    RunEnded,
    Snapshot,
    SnapshotPart,
    SnapshotRequest,
)

RANDOM = np.random.default_rng(1)
FIRST = {"w": RANDOM.normal(size=(300, 200)).astype(np.float32), "b": np.zeros(7, np.float32)}


def snapshot(version: int) -> bytes:
    """Return a snapshot whose weights change a little with every version."""
    weights = {name: array + np.float32(1e-3 * version) * np.sin(array) for name, array in FIRST.items()}
    return encode(Snapshot(learner_epoch=5, policy_version=version, program="p", weights=weights))


def weights_of(encoded: bytes) -> dict[str, np.ndarray]:
    message = decode(encoded, Limits())
    assert isinstance(message, Snapshot)
    return message.weights


def ask(cache: CompactSnapshotCache, newest: bytes, actor: str = "a", **fields: int | None) -> Message:
    request = SnapshotRequest(actor=actor, **{"held_version": None, **fields})  # type: ignore[arg-type] - its fields
    return decode(cache.answer(request, newest), Limits())


def fetch(cache: CompactSnapshotCache, newest: bytes, held: int | None = None, actor: str = "a") -> CompactSnapshot:
    """Fetch all parts and return the decoded compact snapshot."""
    first = ask(cache, newest, actor, held_version=held)
    assert isinstance(first, SnapshotPart)
    parts = [first]
    for number in range(1, first.parts):
        part = ask(cache, b"unused", actor, held_version=held, policy_version=first.policy_version, part=number)
        assert isinstance(part, SnapshotPart)
        assert (part.part, part.parts, part.policy_version) == (number, first.parts, first.policy_version)
        parts.append(part)
    assert all(part.data.nbytes == PART_BYTES for part in parts[:-1])
    whole = decode(b"".join(part.data.tobytes() for part in parts), Limits())
    assert isinstance(whole, CompactSnapshot)
    return whole


def test_actor_without_weights_gets_the_whole_snapshot_in_bfloat16() -> None:
    compact = fetch(CompactSnapshotCache(5), snapshot(3))
    assert (compact.learner_epoch, compact.policy_version, compact.program, compact.base_version) == (5, 3, "p", None)
    for name, array in float32(bits_of(compact.weights, None)).items():
        np.testing.assert_allclose(array, weights_of(snapshot(3))[name], rtol=2**-8)


def test_actor_with_a_known_version_gets_a_small_difference() -> None:
    cache = CompactSnapshotCache(5)
    whole = fetch(cache, snapshot(3))
    held = bits_of(whole.weights, None)
    change = fetch(cache, snapshot(4), held=3)
    assert change.base_version == 3
    expected = bfloat16(weights_of(snapshot(4)))
    for name, array in bits_of(change.weights, held).items():
        np.testing.assert_array_equal(array, expected[name])
    assert len(encode(change)) < len(encode(whole)) / 2


@pytest.mark.parametrize("held", [2, 99])
def test_version_that_was_never_served_is_not_used_as_base(held: int) -> None:
    cache = CompactSnapshotCache(5)
    fetch(cache, snapshot(3))
    assert fetch(cache, snapshot(4), held=held).base_version is None


def test_whole_snapshot_is_sent_when_it_is_smaller_than_the_difference() -> None:
    cache = CompactSnapshotCache(5)
    fetch(cache, snapshot(3))
    noise = {name: RANDOM.normal(size=array.shape).astype(np.float32) for name, array in FIRST.items()}
    other = encode(Snapshot(learner_epoch=5, policy_version=4, program="p", weights=noise))
    compact = fetch(cache, other, held=3)
    assert compact.base_version is None
    np.testing.assert_array_equal(bits_of(compact.weights, None)["w"], bfloat16(noise)["w"])


def test_snapshot_is_encoded_once_for_actors_with_the_same_version(monkeypatch: pytest.MonkeyPatch) -> None:
    cache, made = CompactSnapshotCache(5), []
    encoded = compact_cache._encoded
    monkeypatch.setattr(compact_cache, "_encoded", lambda *arguments: made.append(1) or encoded(*arguments))
    for actor in "abc":
        fetch(cache, snapshot(3), actor=actor)
    assert len(made) == 1
    fetch(cache, snapshot(4), held=3)
    assert len(made) == 2


def test_parts_belong_to_one_version_when_newer_versions_arrive() -> None:
    cache = CompactSnapshotCache(5)
    first = ask(cache, snapshot(3))
    assert isinstance(first, SnapshotPart)
    assert first.parts > 2
    ask(cache, snapshot(4), "b")
    second = ask(cache, snapshot(4), policy_version=3, part=1)
    assert isinstance(second, SnapshotPart)
    assert second.policy_version == 3


def test_parts_are_of_one_whole_snapshot_when_the_base_was_never_held_and_newer_versions_arrive() -> None:
    cache = CompactSnapshotCache(5)
    first = ask(cache, snapshot(3), held_version=1)
    fetch(cache, snapshot(4), held=3, actor="b")
    fetch(cache, snapshot(5), held=1, actor="c")
    assert isinstance(first, SnapshotPart)
    parts = [ask(cache, b"unused", held_version=1, policy_version=3, part=part) for part in range(1, first.parts)]
    whole = decode(b"".join(part.data.tobytes() for part in [first, *parts]), Limits())  # type: ignore[union-attr]
    assert isinstance(whole, CompactSnapshot)
    assert (whole.policy_version, whole.base_version) == (3, None)


def test_a_request_under_the_name_of_another_actor_does_not_end_its_fetch() -> None:
    """No key has the name, so that nobody checks it."""
    cache = CompactSnapshotCache(5)
    first = ask(cache, snapshot(3), "honest")
    ask(cache, snapshot(4), "honest", held_version=3)
    assert isinstance(first, SnapshotPart)
    part = ask(cache, snapshot(4), "honest", policy_version=3, part=1)
    assert isinstance(part, SnapshotPart)
    assert (part.policy_version, part.parts) == (3, first.parts)


@pytest.mark.parametrize(("version", "part"), [(4, 1), (3, 10**6)])
def test_unknown_version_or_part_is_refused(version: int, part: int) -> None:
    cache = CompactSnapshotCache(5)
    ask(cache, snapshot(3))
    answer = ask(cache, snapshot(3), policy_version=version, part=part)
    assert isinstance(answer, Refusal)
    assert answer.code == "unknown"


@pytest.mark.parametrize(
    "instead",
    [Refusal(code="not_ready", reason="no policy yet"), RunEnded(learner_epoch=5, outcome="finished", reason="over")],
)
def test_message_in_place_of_a_snapshot_is_passed_on(instead: Message) -> None:
    assert ask(CompactSnapshotCache(5), encode(instead)) == instead


def test_cache_size_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compact_cache, "_HELD_BYTES", 4 * 2 * (60_000 + 7))
    monkeypatch.setattr(compact_cache, "_PREPARED_BYTES", 3 * 2 * (60_000 + 7))
    cache = CompactSnapshotCache(5)
    for version in range(10):
        fetch(cache, snapshot(version), actor=f"a{version}")
    assert list(cache._held) == [6, 7, 8, 9]
    assert 3 <= len(cache._prepared) < 10
    assert list(cache._prepared)[-1] == (9, None)
    assert sum(len(each.encoded) for each in cache._prepared.values()) <= 3 * 2 * (60_000 + 7)


def test_the_newest_snapshot_is_kept_however_large_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compact_cache, "_PREPARED_BYTES", 1)
    cache = CompactSnapshotCache(5)
    for version in range(3):
        fetch(cache, snapshot(version))
    assert list(cache._prepared) == [(2, None)]


def test_held_versions_that_are_not_held_here_share_one_snapshot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compact_cache, "_MAX_PREPARED", 5)
    cache = CompactSnapshotCache(5)
    for held in range(100, 200):
        ask(cache, snapshot(3), held_version=held)
    assert list(cache._prepared) == [(3, held) for held in range(195, 200)]
    assert len({id(each.encoded) for each in cache._prepared.values()}) == 1
    monkeypatch.setattr(compact_cache, "_PREPARED_BYTES", len(cache._prepared[3, 199].encoded))
    ask(cache, snapshot(3), held_version=200)
    assert len(cache._prepared) == 5  # their bytes count once


def test_a_fetch_in_progress_is_kept_and_others_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(compact_cache.time, "monotonic", lambda: now)
    cache = CompactSnapshotCache(5)
    ask(cache, snapshot(3), "slow")
    fetch(cache, snapshot(4), held=3, actor="left")
    for part, now in ((1, 159.0), (2, 218.0)):  # noqa: B007 - the clock reads it
        ask(cache, b"unused", "slow", policy_version=3, part=part)
    now = 277.0
    fetch(cache, snapshot(5), held=4)
    assert list(cache._prepared) == [(3, None), (5, 4)]
