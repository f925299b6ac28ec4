"""A second, independent implementation of the wire format, and a few messages, for the tests of the codec."""

import contextlib
import dataclasses
import struct
from typing import Any

import msgpack
import numpy as np
from hypothesis import settings
from plain import vector_spaces

from daedalus.protocol.codec import PROTOCOL_VERSION, ProtocolError, decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Join, Message, Snapshot, Welcome
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

LIMITS = Limits()
PREFIX = struct.Struct("<4sHHI")
DTYPES = ("<f4", "|u1", "|b1", "<u2", "<i4", "<i8", "<f8")
repeatable = settings(max_examples=40, deadline=None, derandomize=True)


def wire(content: Any, body: bytes = b"", *, flags: int = 0, version: int = PROTOCOL_VERSION) -> bytes:
    """Return the bytes of a message with this header."""
    return wire_header(msgpack.packb(content) or b"", body, flags=flags, version=version)


def wire_header(header: bytes, body: bytes = b"", *, flags: int = 0, version: int = PROTOCOL_VERSION) -> bytes:
    prefix = PREFIX.pack(b"DAED", version, flags, len(header))
    return prefix + header + bytes(-(len(prefix) + len(header)) % 8) + body


def unwire(data: bytes) -> tuple[int, dict[str, Any], bytes]:
    """Return flags, header content and body of a message."""
    magic, version, flags, length = PREFIX.unpack_from(data)
    assert (magic, version) == (b"DAED", PROTOCOL_VERSION)
    end = PREFIX.size + length
    start = end + -end % 8
    assert not any(data[end:start])
    return flags, msgpack.unpackb(data[PREFIX.size : end]), data[start:]


def bits(random: np.random.Generator, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return arrays of any bit pattern, including NaN and infinity."""
    if dtype == "|b1":
        return random.integers(0, 2, shape).astype(np.bool_)
    count = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return np.frombuffer(random.bytes(count), dtype).reshape(shape)


def the_same(left: Any, right: Any) -> bool:
    """Return whether two messages are equal, with arrays compared bit for bit."""
    if type(left) is not type(right):
        return False
    if isinstance(left, np.ndarray):
        return (left.dtype, left.shape, left.tobytes()) == (right.dtype, right.shape, right.tobytes())
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(the_same(left[key], right[key]) for key in left)
    if dataclasses.is_dataclass(left):
        names = [field.name for field in dataclasses.fields(left)]
        return all(the_same(getattr(left, name), getattr(right, name)) for name in names)
    return left == right


def arrays_of(message: Message) -> list[np.ndarray]:
    values = [getattr(message, field.name) for field in dataclasses.fields(message)]
    values += [array for value in values if isinstance(value, dict) for array in value.values()]
    return [value for value in values if isinstance(value, np.ndarray)]


def decoded_or_refused(data: bytes, limits: Limits = LIMITS) -> None:
    """Decode bytes; any exception except ProtocolError fails the calling test."""
    with contextlib.suppress(ProtocolError):
        assert isinstance(decode(data, limits), Message)


IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=2, learner_epoch=3)
JOIN = Join(
    actor="a",
    incarnation=7,
    spaces=vector_spaces(4, 2),
)
SNAPSHOT = Snapshot(
    learner_epoch=1,
    policy_version=2,
    program="abc",
    weights={"w": np.array([[1.0, 2.0], [3.0, 4.0]], np.float32), "b": np.array([1, 2, 3], np.uint8)},
)
WELCOME = Welcome(run="r", learner_epoch=1, seed=1, spec=RunSpec(environment=EnvironmentSpec(id="x")).for_actors())
STATUS = wire(  # every field of a status, as another implementation could write it
    {
        "kind": "StatusReport",
        "fields": {
            "status": {
                **dict.fromkeys(("run", "algorithm", "environment"), "x"),
                **dict.fromkeys(("learner_epoch", "env_steps", "env_steps_budget", "updates"), 1),
                **dict.fromkeys(("uptime_seconds", "env_steps_per_second", "updates_per_second"), 1.0),
                "policy_lag_mean": 0.0,
                **dict.fromkeys(("actors_alive", "actors_quarantined", "actors_gone"), 0),
                **dict.fromkeys(("rollouts_accepted", "rollouts_missed", "busy_answers"), 0),
                **dict.fromkeys(("updates_skipped", "queue_bytes", "queue_bytes_limit"), 0),
                **dict.fromkeys(("episode_return_mean", "checkpoint_age_seconds", "certificate_days_left")),
                "problems": [],
                "refused_joins": [],
                "rollouts_rejected": {},
                "actors": [],
            }
        },
        "arrays": [],
        "size": 0,
    }
)


def some_rollout(frames: np.ndarray | None = None) -> Rollout:
    """Return a rollout of eight rows and four environments with a state of size two."""
    rows = np.zeros((8, 4))
    return Rollout(
        identity=IDENTITY,
        policy_version=5,
        frames={"observation": np.zeros((9, 4, 3), np.float32) if frames is None else frames},
        initial_state=np.zeros((4, 2), np.float32),
        actions={"action": rows.astype(np.int64)[..., None]},
        masks={},
        behaviour_log_probs=rows.astype(np.float32),
        rewards=rows.astype(np.float32),
        terminated=rows.astype(np.bool_),
        truncated=rows.astype(np.bool_),
        valid=rows.astype(np.bool_),
        episode_returns=np.zeros(1, np.float32),
        episode_lengths=np.zeros(1, np.int32),
    )


PIXELS = np.arange(4 * 9 * 6, dtype=np.uint8).reshape(4, 9, 2, 3).swapaxes(0, 1)  # with the environment axis first
SAMPLES = {"join": encode(JOIN), "snapshot": encode(SNAPSHOT), "rollout": encode(some_rollout()), "status": STATUS}
SAMPLES["pixels"] = encode(some_rollout(PIXELS))
