"""What a WebSocket of our server does beyond ASGI. The application finds it in `scope["extensions"]["daedalus"]`."""

from collections.abc import Callable
from typing import Any, Protocol, cast

HELLO_SECONDS = 10.0  # from the connection to the hello
SEND_SECONDS = 5.0  # for the last message


class Channel(Protocol):
    """One WebSocket."""

    def limit(self, size: int) -> None:
        """Set the largest message, before memory is allocated for it."""
        ...

    @property
    def peer(self) -> str:
        """Who is at the other end, for those without a token: a user of this machine, or an address."""
        ...

    def settle(self, settled: bool) -> None:
        """Note whether the connection has a place. One without gives way to newer connections."""
        ...

    def divert(self, on_message: Callable[[str | bytes], None], on_writable: Callable[[], None]) -> None:
        """Call functions from now on, in place of queueing messages, which costs a switch of tasks for each message.

        Args:
          on_message: receives each message. The end of the connection still comes by ASGI.
          on_writable: called when the client reads again.
        """
        ...

    @property
    def is_writable(self) -> bool:
        """Whether the client reads what is written."""
        ...

    def write(self, data: str | bytes) -> None:
        """Send a message. Without effect once the connection ends."""
        ...

    def acknowledge(self) -> None:
        """Acknowledge what has come at once. For a message without an answer: the client may wait to send the next."""
        ...

    def pause(self, paused: bool) -> None:
        """Stop reading messages, or go on. Only after `divert`. Idempotent."""
        ...


def channel_of(scope: Any) -> Channel:
    """Return the channel of a WebSocket's scope."""
    return cast(Channel, scope["extensions"]["daedalus"])
