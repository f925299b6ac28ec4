"""Errors that a client receives."""

from typing import Literal

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
