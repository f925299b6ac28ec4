"""The messages of a page to the gateway: decoding. Pure functions."""

import json
from typing import Any, Literal, NamedTuple

from daedalus.gateway.errors import ClientError
from daedalus.protocol.messages import Order

MAX_BYTES = 4096


class ViewerHello(NamedTuple):
    """The first message of a page."""

    token: str


class ViewerOrder(NamedTuple):
    """An order to the learner."""

    order: Order
    token: str  # of an operator


class ViewerCamera(NamedTuple):
    """Whether the page shows the camera."""

    on: bool


ViewerMessage = ViewerHello | ViewerOrder | ViewerCamera
_FIELDS: dict[str, set[str]] = {
    "hello": {"type", "token"},
    "order": {"type", "order", "token"},
    "camera": {"type", "on"},
}


def read(data: str | bytes | None) -> ViewerMessage:
    """Return a message of a page. Raises ClientError if it is malformed."""
    message = _decoded(data)
    kind = message.get("type")
    if not isinstance(kind, str) or message.keys() != _FIELDS.get(kind):
        raise ClientError("malformed", "the message is none that a page sends")
    match message:
        case {"type": "hello", "token": str(token)}:
            return ViewerHello(token)
        case {"type": "order", "order": "stop" | "checkpoint" as order, "token": str(token)}:
            chosen: Literal["stop", "checkpoint"] = order
            return ViewerOrder(chosen, token)
        case {"type": "camera", "on": bool(on)}:
            return ViewerCamera(on)
        case _:
            raise ClientError("malformed", f"{kind} has a field of a wrong type")


def _decoded(data: str | bytes | None) -> dict[str, Any]:
    if not isinstance(data, str) or len(data) > MAX_BYTES:
        raise ClientError("malformed", f"a message must be JSON of at most {MAX_BYTES} bytes")
    try:
        message = json.loads(data)
    except (ValueError, RecursionError):
        raise ClientError("malformed", "the message is not JSON") from None
    if not isinstance(message, dict):
        raise ClientError("malformed", "the message is not a map")
    return message
