"""Sends the full rollouts of all clients. For the gateway's event loop."""

import asyncio

from daedalus.gateway.client_uploads import ClientUploads


class Outbox:
    """The clients that have a rollout to send.

    Encoding takes longer than the choice of an action, and clients that began together fill their rollouts together. So
    each turn of the event loop encodes one rollout for the sender (sender.py), and answers clients between them.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._ready: dict[ClientUploads, None] = {}  # in the order in which they are sent

    def add(self, uploads: ClientUploads) -> None:
        """Send the rollouts of a client, soon."""
        if not self._ready:
            self._loop.call_soon(self._send_one)
        self._ready[uploads] = None

    def _send_one(self) -> None:
        uploads = next(iter(self._ready))
        del self._ready[uploads]
        uploads.send_one()
        if uploads.can_send:
            self._ready[uploads] = None
        if self._ready:
            self._loop.call_soon(self._send_one)
