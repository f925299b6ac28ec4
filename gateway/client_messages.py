"""The messages of a client and of the gateway: decoding, encoding, and which may follow which. Pure functions.

gateway/protocol.json is the same as a JSON Schema. A client sends JSON in text frames, or msgpack in binary frames; the
answers have the form of its hello.
"""

import json
import math
from typing import Any, Literal, NamedTuple

import msgpack

ErrorCode = Literal[
    "malformed",  # not a message of this protocol
    "out_of_turn",
    "misfit",  # a value does not fit the spaces
    "refused",  # by the learner or by the gateway; do not try again as you are
    "unavailable",  # no learner, or no room: try again later
]


class ClientError(Exception):
    """A fault of the client, or a reason why it cannot take part; the text says what to do."""

    def __init__(self, code: ErrorCode, reason: str) -> None:
        super().__init__(reason)
        self.code, self.reason = code, reason


VERSION = 1
MAX_HELLO_BYTES = 256 << 10

State = Literal["new", "ready", "acted"]
# What a client may send in each state, and the state after the gateway's answer.
TRANSITIONS: dict[tuple[State, str], State] = {
    ("new", "hello"): "ready",
    ("ready", "act"): "acted",
    ("acted", "act"): "acted",
    ("acted", "reward"): "acted",
    ("acted", "end_episode"): "ready",
}
_HINTS = {
    "new": "send a hello first",
    "ready": "send an act first: the episode has no action yet",
    "acted": "a connection has one hello",
}


class Hello(NamedTuple):
    """A client introduces itself."""

    name: str
    observations: Any  # of protocol/spaces.py, as JSON
    actions: Any
    token: str


class Act(NamedTuple):
    """A client asks for an action."""

    observation: Any
    action_mask: Any
    reward: float  # of the last action; it is added to those that came before
    override: Any = None  # the action that is played in place of the policy's


class Reward(NamedTuple):
    """A reward of the last action."""

    reward: float


class EndEpisode(NamedTuple):
    """The episode has ended with the last action."""

    terminated: bool
    observation: Any  # the last one; None if it is not known
    reward: float


ClientMessage = Hello | Act | Reward | EndEpisode

_FIELDS: dict[str, tuple[set[str], set[str]]] = {  # required and optional fields of each type
    "hello": ({"version", "name", "observations", "actions"}, {"token"}),
    "act": ({"observation"}, {"action_mask", "reward", "override"}),
    "reward": ({"reward"}, set()),
    "end_episode": ({"terminated"}, {"observation", "reward"}),
}
_to_json = json.JSONEncoder(separators=(",", ":")).encode
_ALLOWED = {kind: {"type"} | required | optional for kind, (required, optional) in _FIELDS.items()}


def read(data: str | bytes, state: State) -> ClientMessage:
    """Return a client's message. Raises ClientError if it is malformed, or not legal in this state."""
    message = _decoded(data)
    kind = message.get("type") if isinstance(message, dict) else None
    if not isinstance(kind, str) or kind not in _FIELDS:
        raise ClientError("malformed", f"the message has no type that a client sends: use one of {', '.join(_FIELDS)}")
    if (state, kind) not in TRANSITIONS:
        raise ClientError("out_of_turn", f"{kind} is out of turn: {_HINTS[state]}")
    unknown = message.keys() - _ALLOWED[kind]
    if unknown:
        raise ClientError("malformed", f"{kind} has an unknown field {_shown(min(unknown, key=str))}")
    missing = _FIELDS[kind][0] - message.keys()
    if missing:
        raise ClientError("malformed", f"{kind} lacks the field {min(missing)!r}")
    match kind:
        case "act":
            reward = _number(message.get("reward", 0.0))
            return Act(message["observation"], message.get("action_mask"), reward, message.get("override"))
        case "reward":
            return Reward(_number(message["reward"]))
        case "end_episode":
            terminated = message["terminated"]
            if not isinstance(terminated, bool):
                raise ClientError("malformed", "terminated must be true or false")
            return EndEpisode(terminated, message.get("observation"), _number(message.get("reward", 0.0)))
        case _:
            return _hello(message)


def _hello(message: dict[str, Any]) -> Hello:
    if message["version"] != VERSION:
        raise ClientError("refused", f"the client uses version {_shown(message['version'])}, the gateway {VERSION}")
    name, token = message["name"], message.get("token", "")
    if not isinstance(name, str) or not isinstance(token, str):
        raise ClientError("malformed", "name and token must be text")
    return Hello(name, message["observations"], message["actions"], token)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ClientError("malformed", "a reward must be a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ClientError("malformed", "a reward must be finite")
    return number


def _decoded(data: str | bytes) -> Any:
    try:
        if isinstance(data, str):
            return json.loads(data)
        return msgpack.unpackb(data)
    except (ValueError, RecursionError, msgpack.UnpackException):
        form = "JSON" if isinstance(data, str) else "msgpack"
        raise ClientError("malformed", f"the message is not {form}") from None


def _shown(value: Any) -> str:
    return ascii(value)[:40]


# --------------------------------------------------------------------------------------- of the gateway


def encode(message: dict[str, Any], *, as_text: bool) -> str | bytes:
    """Return a message of the gateway as JSON or msgpack."""
    if as_text:
        return _to_json(message)
    packed = msgpack.packb(message)
    assert packed is not None  # its annotation is for streams too
    return packed


def welcome(run: str, environment: str, name: str) -> dict[str, Any]:
    """Return the answer to hello."""
    return {"type": "welcome", "version": VERSION, "run": run, "environment": environment, "name": name}


def action(value: Any) -> dict[str, Any]:
    """Return the answer to act."""
    return {"type": "action", "action": value}


def error(fault: ClientError) -> dict[str, Any]:
    """Return the message about a fault."""
    return {"type": "error", "code": fault.code, "reason": fault.reason}


def run_ended(reason: str) -> dict[str, Any]:
    """Return the last message of a run."""
    return {"type": "run_ended", "reason": reason}
