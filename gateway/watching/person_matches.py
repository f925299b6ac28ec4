"""Matches of persons against the policy, on the page: a process for each person who plays. For the event loop."""

import asyncio
import contextlib
import json
from collections.abc import AsyncGenerator, Sequence
from functools import partial
from typing import Any, NamedTuple

from daedalus.gateway.learner_link import NewestPolicy
from daedalus.gateway.places import Places
from daedalus.gateway.watching.playing_process import (
    LONGEST_END_SECONDS,
    PolicySource,
    note,
    run_process,
    send,
    send_policy,
)
from daedalus.protocol.codec import encode

_MOST = 4  # persons at a time: each process takes about 150 MB
_MOST_ORDERS, _MOST_FRAMES = 16, 4  # of one person, that wait; of the frames, the newest
_IDLE_SECONDS = 600.0  # without an order; then the process ends
_FETCH_SECONDS = 1.0  # for a newer policy, while the process starts
_POLL_SECONDS = 0.2  # for the first policy


class BeginMatch(NamedTuple):
    """A person takes a seat in a new match."""

    agent: str  # empty: the first
    sampled: bool  # whether the policy samples its actions


class PlayMove(NamedTuple):
    """A person acts."""

    turn: int  # that it is for: another move may have come before
    action: dict[str, list[float]]


MatchOrder = BeginMatch | PlayMove


class Matches:
    """All persons who play at this gateway."""

    def __init__(self, command: Sequence[str], policies: PolicySource) -> None:
        """`command` starts a process; the program is the first word."""
        self._command, self._policies = command, policies
        self.places = Places(_MOST, "matches against the policy")
        self._tasks: set[asyncio.Task[None]] = set()

    async def play(self, orders: "asyncio.Queue[MatchOrder]") -> AsyncGenerator[bytes, None]:
        """Yield frames for one person, the newest ones only, until the caller stops or no order comes any more."""
        frames: asyncio.Queue[bytes | None] = asyncio.Queue(_MOST_FRAMES)

        def show(frame: bytes | None) -> None:
            if frames.full():
                frames.get_nowait()
            frames.put_nowait(frame)

        task = asyncio.create_task(_Person(self._command, self._policies, orders, show).run())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(lambda _: show(None))
        try:
            while (frame := await frames.get()) is not None:
                yield frame
        finally:
            task.cancel()
            await asyncio.wait([task])  # the place is taken until the process has ended

    async def close(self) -> None:
        """End all processes. At most about 4 s."""
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(list(self._tasks), timeout=LONGEST_END_SECONDS)


def new_orders() -> "asyncio.Queue[MatchOrder]":
    """Return a bounded queue for the orders of one person."""
    return asyncio.Queue(_MOST_ORDERS)


class _Person:
    """One process after the other for one person: another learner epoch needs another one."""

    def __init__(
        self, command: Sequence[str], policies: PolicySource, orders: "asyncio.Queue[MatchOrder]", show: Any
    ) -> None:
        self._command, self._policies, self._orders, self._show = command, policies, orders, show
        self._order: MatchOrder | None = None  # that no process has received
        self._is_answered = True  # whether a frame has come since the last order
        self._is_idle = False
        self._waits_for_other = False  # whether the order is for another process, with the policy of another session

    async def run(self) -> None:
        """Serve the person until no order comes any more."""
        while (order := await self._next()) is not None:
            policy = self._policies.newest()
            if policy is None:
                self._show(note("There is no policy yet: the match begins as soon as there is one."))
                try:
                    async with asyncio.timeout(_IDLE_SECONDS):
                        while self._policies.newest() is None:
                            await asyncio.sleep(_POLL_SECONDS)
                except TimeoutError:
                    self._refuse("There is still no policy: begin the match again later.")
            elif not policy.session.spec.environment.is_game:
                name = policy.session.spec.environment.id
                self._refuse(f"The run plays {name}, which is no game with several agents.")
            elif not isinstance(order, BeginMatch):
                self._refuse("The match is over: begin another one.")
            else:
                await self._serve(policy)
        self._show(note(f"The match ended: no move came for {_IDLE_SECONDS / 60:g} minutes."))

    def _refuse(self, reason: str) -> None:
        self._order = None
        self._show(note(reason))

    async def _serve(self, policy: NewestPolicy) -> None:
        self._waits_for_other = False
        try:
            await run_process(self._command, partial(self._feed, policy), self._answer)
        except OSError as error:
            self._refuse(f"The match cannot be started: {error.strerror}")
            return
        if not (self._is_answered if self._order is None else self._waits_for_other or self._is_idle):
            self._refuse("The process of the match has ended: begin another match.")

    def _answer(self, frame: bytes) -> None:
        self._is_answered = True
        self._show(frame)

    async def _next(self) -> MatchOrder | None:
        """Return the next order that no process has received; None if none comes any more."""
        if self._order is None and not self._is_idle:
            try:
                async with asyncio.timeout(_IDLE_SECONDS):
                    self._order = await self._orders.get()
            except TimeoutError:
                self._is_idle = True
        return self._order

    async def _feed(self, policy: NewestPolicy, writer: asyncio.StreamWriter) -> None:
        """Send the policy, and orders; before each match the newest policy. Return before one of another session."""
        held = await self._newest_of(policy)
        await send_policy(writer, held)
        while (order := await self._next()) is not None:
            newest = self._policies.newest()
            if isinstance(order, BeginMatch) and newest is not None and newest is not held:
                if newest.session is not held.session:
                    self._waits_for_other = True
                    return
                held = newest
                await send(writer, encode(held.snapshot))
            self._order, self._is_answered = None, False
            await send(writer, json.dumps({"type": type(order).__name__, **order._asdict()}).encode())
            self._policies.fetch()  # for the next match

    async def _newest_of(self, policy: NewestPolicy) -> NewestPolicy:
        """Return a newer policy of the same session if one comes soon: nobody may have asked for one for long."""
        self._policies.fetch()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_FETCH_SECONDS):
                while self._policies.newest() is policy:
                    await asyncio.sleep(_FETCH_SECONDS / 20)
        newest = self._policies.newest()
        return newest if newest is not None and newest.session is policy.session else policy
