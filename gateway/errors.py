"""Errors that a client receives."""


class ClientError(Exception):
    """A fault of the client, or a reason why it cannot take part; the text says what to do."""

    def __init__(self, code: str, reason: str) -> None:
        """`code` is one of messages.ERROR_CODES."""
        super().__init__(reason)
        self.code, self.reason = code, reason
