"""Limits on the number of clients, and on the bytes and queries of all. State with a lock, no threads."""

import threading
import time
from dataclasses import dataclass
from typing import Protocol

from daedalus.gateway.raw.budget import QueryPool

MAX_RAW_CLIENTS = 64  # that have sent a packet
_MAX_NEW_CONNECTIONS = 64  # that have not sent a packet yet
IDLE_SECONDS = 60.0  # a client that sent nothing for this time may lose its place to a new client
# Bytes of unanswered queries and unread answers. One more message is accepted below a limit: weights of any size fit.
CLIENT_BYTES = 128 << 20
TOTAL_BYTES = 512 << 20


class Client(Protocol):
    """What the table requires of a connection."""

    def drop(self, reason: str) -> None:
        """Disconnect the client. Returns at once."""
        ...


@dataclass(slots=True)
class _Usage:
    heard: float  # monotonic time of the last packet
    is_admitted: bool = False
    held: int = 0  # bytes


class ClientTable:
    """Decides which clients a gateway serves, and drops the client that takes too much."""

    def __init__(self) -> None:
        self.queries = QueryPool()
        self._lock = threading.Lock()
        self._usage: dict[Client, _Usage] = {}  # oldest first

    def connect(self, client: Client) -> None:
        """Register a connection; drop the oldest connection that sent no packet yet if there are too many."""
        with self._lock:
            new = [each for each, usage in self._usage.items() if not usage.is_admitted]
            self._usage[client] = _Usage(heard=time.monotonic())
            is_full = len(new) >= _MAX_NEW_CONNECTIONS
            if is_full:
                self._usage.pop(new[0])
        if is_full:
            new[0].drop(f"it sent no packet, and {_MAX_NEW_CONNECTIONS} newer connections wait")

    def admit(self, client: Client) -> bool:
        """Give a client that sent a packet a place; if there is none, take the place of the longest silent client.

        Returns False if all places are taken by clients that sent something within `IDLE_SECONDS`.
        """
        now = time.monotonic()
        with self._lock:
            admitted = [(usage.heard, each) for each, usage in self._usage.items() if usage.is_admitted]
            heard, idlest = min(admitted, key=lambda entry: entry[0], default=(now, None))
            is_full = len(admitted) >= MAX_RAW_CLIENTS
            if client not in self._usage or (is_full and now - heard < IDLE_SECONDS):
                return False
            if is_full and idlest is not None:
                self._usage.pop(idlest)
            self._usage[client].is_admitted = True
        if is_full and idlest is not None:
            idlest.drop(f"it sent nothing for {now - heard:.0f} s, and a new client needs its place")
        return True

    def heard(self, client: Client) -> None:
        """Note that a client sent a packet."""
        with self._lock:
            if usage := self._usage.get(client):
                usage.heard = time.monotonic()

    def hold(self, client: Client, size: int) -> None:
        """Count bytes held for a client.

        Drops the client if it held more than `CLIENT_BYTES` before; if all together held more than `TOTAL_BYTES`, drops
        the client that holds the most.
        """
        dropped, reason = None, ""
        with self._lock:
            usage = self._usage.get(client)
            if usage is None:
                return  # already dropped
            total = sum(each.held for each in self._usage.values())
            if usage.held > CLIENT_BYTES:
                dropped, reason = client, f"{usage.held:,} bytes of its queries and unread answers wait"
            elif total > TOTAL_BYTES:
                dropped = max(self._usage, key=lambda each: self._usage[each].held)
                share = self._usage[dropped].held
                reason = f"{total:,} bytes of queries and answers wait in the gateway, most of them ({share:,}) its own"
            usage.held += size
            if dropped is not None:
                self._usage.pop(dropped)
        if dropped is not None:
            dropped.drop(reason)

    def release(self, client: Client, size: int) -> None:
        """Count bytes that are no longer held."""
        with self._lock:
            if usage := self._usage.get(client):
                usage.held -= size

    def remove(self, client: Client) -> None:
        """Forget a client whose connection ended."""
        with self._lock:
            self._usage.pop(client, None)
