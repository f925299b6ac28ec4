"""The messages of a client and of the gateway: decoding, encoding, and which may follow which. Pure functions.

gateway/protocol.json is the same as a JSON Schema. A client sends JSON in text frames, or msgpack in binary frames; the
answers have the form of its hello.
"""

import itertools
import json
import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import msgpack

from daedalus.actor.collecting.client_seats import MatchSeat, match_seats
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.releases import own_release

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
_MOST_NAMES = 6  # of seats in a message

State = Literal["new", "ready", "acted"]
# What a client may send in each state, and the state after the gateway's answer.
TRANSITIONS: dict[tuple[State, str], State] = {
    ("new", "hello"): "ready",
    ("ready", "parameters"): "ready",
    ("ready", "act"): "acted",
    ("acted", "act"): "acted",
    ("acted", "reward"): "acted",
    ("acted", "end_episode"): "ready",
}
_HINTS = {
    "new": "send a hello first",
    "ready": "send an act first: the episode has no action yet",
    "acted": "a connection has one hello, and parameters are asked for before an episode",
}


class Hello(NamedTuple):
    """A client introduces itself."""

    name: str
    observations: Any  # of protocol/spaces.py, as JSON
    actions: Any
    token: str
    match: tuple[MatchSeat, ...] = ()  # the seats that the client holds; empty: it plays no match


class AskParameters(NamedTuple):
    """A client asks for the parameters of the environment in the episode that begins next."""

    seat: str = ""


class Act(NamedTuple):
    """A client asks for an action."""

    observation: Any
    action_mask: Any
    reward: float  # of the last action; it is added to those that came before
    override: Any = None  # the action that is played in place of the policy's
    seat: str = ""  # of the match that acts; empty without a match


class Reward(NamedTuple):
    """A reward of the last action."""

    reward: float
    seat: str = ""


class EndEpisode(NamedTuple):
    """The episode has ended with the last action."""

    terminated: bool
    observation: Any  # the last one; None if it is not known
    reward: float
    seat: str = ""


ClientMessage = Hello | AskParameters | Act | Reward | EndEpisode

_FIELDS: dict[str, tuple[set[str], set[str]]] = {  # required and optional fields of each type
    "hello": ({"version", "name", "observations", "actions"}, {"token", "match"}),
    "parameters": (set(), {"seat"}),
    "act": ({"observation"}, {"action_mask", "reward", "override", "seat"}),
    "reward": ({"reward"}, {"seat"}),
    "end_episode": ({"terminated"}, {"observation", "reward", "seat"}),
}
_to_json = json.JSONEncoder(separators=(",", ":")).encode
_ALLOWED = {kind: {"type"} | required | optional for kind, (required, optional) in _FIELDS.items()}


def read(data: str | bytes, states: Mapping[str, State]) -> ClientMessage:
    """Return a client's message. Raises ClientError if it is malformed, or not legal in this state.

    `states` are those of the client's seats by name, or that of a client without a match under the empty name.
    """
    message = _decoded(data)
    kind = message.get("type") if isinstance(message, dict) else None
    if not isinstance(kind, str) or kind not in _FIELDS:
        raise ClientError("malformed", f"the message has no type that a client sends: use one of {', '.join(_FIELDS)}")
    seat = message.get("seat", "")
    if kind == "hello":
        seat, state = "", next(iter(states.values()))
    elif not isinstance(seat, str) or seat not in states:
        raise ClientError("misfit", _seat_fault(kind, seat, states))
    else:
        state = states[seat]
    if (state, kind) not in TRANSITIONS:
        raise ClientError("out_of_turn", f"{kind} is out of turn: {_HINTS[state]}")
    unknown = message.keys() - _ALLOWED[kind]
    if unknown:
        raise ClientError("malformed", f"{kind} has an unknown field {_shown(min(unknown, key=str))}")
    missing = _FIELDS[kind][0] - message.keys()
    if missing:
        raise ClientError("malformed", f"{kind} lacks the field {min(missing)!r}")
    match kind:
        case "parameters":
            return AskParameters(seat)
        case "act":
            reward = _number(message.get("reward", 0.0))
            return Act(message["observation"], message.get("action_mask"), reward, message.get("override"), seat)
        case "reward":
            return Reward(_number(message["reward"]), seat)
        case "end_episode":
            terminated = message["terminated"]
            if not isinstance(terminated, bool):
                raise ClientError("malformed", "terminated must be true or false")
            return EndEpisode(terminated, message.get("observation"), _number(message.get("reward", 0.0)), seat)
        case _:
            return _hello(message)


def _hello(message: dict[str, Any]) -> Hello:
    if message["version"] != VERSION:
        raise ClientError("refused", _other_version(message["version"]))
    name, token = message["name"], message.get("token", "")
    if not isinstance(name, str) or not isinstance(token, str):
        raise ClientError("malformed", "name and token must be text")
    return Hello(name, message["observations"], message["actions"], token, _match(message.get("match")))


def _other_version(version: Any) -> str:
    """Return which end to upgrade, where the client has another version of these messages."""
    newer = type(version) is int and version > VERSION
    remedy = "upgrade the gateway" if newer else f"use the client files of {own_release()}, in examples/gateway"
    return f"the client uses version {_shown(version)}, the gateway {VERSION}, which {own_release()} has: {remedy}"


def _match(value: Any) -> tuple[MatchSeat, ...]:
    if value is None:
        return ()
    match value:
        case {"seats": [*seats], "turns": bool(turns)} if len(value) == len(("seats", "turns")):
            try:
                return tuple(match_seats(seats, turns=turns))
            except ValueError as error:
                raise ClientError("malformed", str(error)) from None
    raise ClientError("malformed", "match must have seats, a list of names, and turns, true or false")


def _seat_fault(kind: str, seat: Any, states: Mapping[str, State]) -> str:
    if "" in states:
        return f"{kind} names the seat {_shown(seat)}, but the hello has no match with seats"
    known = ", ".join(itertools.islice(states, _MOST_NAMES))
    return f"{kind} {f'names the seat {_shown(seat)}' if seat else 'names no seat'}: the match of the hello has {known}"


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


def parameters(values: Parameters, seat: str = "") -> dict[str, Any]:
    """Return the answer to parameters."""
    message = {"type": "parameters", "parameters": dict(values)}
    return {**message, "seat": seat} if seat else message


def action(value: Any, seat: str = "") -> dict[str, Any]:
    """Return the answer to act."""
    message = {"type": "action", "action": value}
    return {**message, "seat": seat} if seat else message


def error(fault: ClientError, seat: str = "") -> dict[str, Any]:
    """Return the message about a fault, of a seat's message if it is known."""
    message = {"type": "error", "code": fault.code, "reason": fault.reason}
    return {**message, "seat": seat} if seat else message


def run_ended(reason: str) -> dict[str, Any]:
    """Return the last message of a run."""
    return {"type": "run_ended", "reason": reason}
