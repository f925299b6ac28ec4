"""The presence of one client in a run, as the network knows it. For the gateway's event loop, with a thread."""

import asyncio
import contextlib
from concurrent.futures import ThreadPoolExecutor

from daedalus.transport.interface import Declaration, Transport


class Presence:
    """Declares and withdraws the presence of one actor.

    A congested link makes both wait. So one thread performs them for all actors, in the order of the calls.
    """

    def __init__(self, transport: Transport, thread: ThreadPoolExecutor) -> None:
        """`thread` has one worker."""
        self._transport, self._thread = transport, thread
        self._key = ""  # that is declared; this and the next are the thread's
        self._declaration: Declaration | None = None

    async def declare(self, key: str) -> None:
        """Be present under one key, and no other. Raises TransportError.

        If the call is cancelled, the key may be declared all the same: call `withdraw`.
        """
        await asyncio.get_running_loop().run_in_executor(self._thread, self._declare, key)

    def withdraw(self) -> None:
        """Be present no longer. Returns at once."""
        with contextlib.suppress(RuntimeError):  # the thread has ended: the transport withdraws it when it is closed
            asyncio.get_running_loop().run_in_executor(self._thread, self._withdraw)

    def _declare(self, key: str) -> None:
        if self._key != key:
            self._withdraw()
            self._declaration = self._transport.declare_presence(key)
            self._key = key

    def _withdraw(self) -> None:
        declaration, self._declaration, self._key = self._declaration, None, ""
        if declaration is not None:
            declaration.close()
