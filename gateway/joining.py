"""Lets clients take part in the run: requests to join its learner. For the gateway's event loop, with threads."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

from daedalus.actor.errors import ActorError, LearnerLostError
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import Ask, Conversation, DeclarePresence, RunOverError, Steps, Wait, Work
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_messages import ClientError
from daedalus.gateway.learner_link import LearnerLink
from daedalus.protocol.messages import Welcome
from daedalus.transport.interface import Declaration, Transport, TransportError


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


class FollowedRun:
    """The learner of the run, and how the last run ended."""

    def __init__(self) -> None:
        self.session: Welcome | None = None  # of the learner that is followed
        self.name = ""  # of the run that is or was followed
        self.last_end = ""  # how the last run ended, until another begins
        self.on_change: Callable[[], None] = lambda: None  # called when a learner was found, or a run has ended
        self._changed = asyncio.Event()

    def begin(self, session: Welcome) -> None:
        """Follow a learner."""
        self.session, self.name, self.last_end = session, session.run, ""
        self.announce()
        self.on_change()

    def end(self, reason: str) -> None:
        """Note that the run has ended."""
        self.session, self.last_end = None, reason
        self.on_change()

    def announce(self) -> None:
        """Wake those that wait for a change."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def change(self) -> None:
        """Wait for another learner, or for a policy."""
        await self._changed.wait()


_THREADS = 16  # requests at the same time, which may wait
_RETRY_SECONDS = 0.2  # how soon a client that joins notices that another learner is followed


@dataclass(slots=True)
class Seat:
    """An actor of the gateway, while its client is connected."""

    actor: ClientActor
    on_end: Callable[[ClientError | str], None]  # ends its connection, with an error or how the run ended
    presence: Presence
    is_joining: bool = False

    def is_in(self, session: Welcome | None) -> bool:
        """Return whether the actor takes part in a session."""
        return session is not None and self.actor.epoch == session.learner_epoch


class Joining:
    """Requests to join the learner that is followed."""

    def __init__(self, transport: Transport, link: LearnerLink, run: FollowedRun) -> None:
        self._transport, self._link, self._run = transport, link, run
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="join")
        self._presence_thread = ThreadPoolExecutor(1, thread_name_prefix="presence")

    def presence(self) -> Presence:
        """Return the presence of an actor, not declared yet."""
        return Presence(self._transport, self._presence_thread)

    def close(self) -> None:
        """Begin no further requests."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._presence_thread.shutdown(wait=False, cancel_futures=True)

    async def join(self, seat: Seat) -> None:
        """Join the newest learner, once there is one. Raises ClientError if the client cannot take part."""
        seat.is_joining = True
        try:
            while (session := self._run.session) is None or not await self._join(seat, session):
                if self._run.session is None:
                    await self._run.change()
        finally:
            seat.is_joining = False

    async def rejoin(self, seat: Seat) -> None:
        """Join a learner that has restarted, or that the network had lost; end the connection if that fails."""
        try:
            await self.join(seat)
        except ClientError as error:
            seat.on_end(error)

    async def _join(self, seat: Seat, session: Welcome) -> bool:
        """Join the learner of a session; return False once another learner is followed, or none."""
        join, transforms = seat.actor.prepare(session.spec)
        conversation = Conversation(ActorConfig(name=join.actor, incarnation=join.incarnation))
        steps = conversation.confirm(session, join, asks_only=True)
        try:
            welcome = await self._perform(seat, session, conversation, steps)
        except LearnerLostError:
            self._link.look_again()
            await asyncio.sleep(_RETRY_SECONDS)
            return False
        except (ActorError, RunOverError, TransportError) as error:
            raise ClientError("refused", str(error)) from None
        if welcome is None or session is not self._run.session:
            return False
        seat.actor.joined(welcome, transforms)  # with the client's own epsilon
        return True

    async def _perform(
        self, seat: Seat, session: Welcome, conversation: Conversation, steps: Steps[Welcome]
    ) -> Welcome | None:
        """Perform the actions of a client that joins; return the learner's answer, or None after another session."""
        came: Any = None
        while session is self._run.session:
            conversation.now = time.monotonic()
            try:
                action = steps.send(came)
            except StopIteration as end:
                return end.value
            for declaration in conversation.take_actions():
                assert isinstance(declaration, DeclarePresence)
                await seat.presence.declare(declaration.key)
            came = await self._come_of(action)
        return None

    async def _come_of(self, action: Ask | Work | Wait) -> Any:
        """Perform an action, and return what came of it."""
        match action:
            case Wait(until):
                left = _RETRY_SECONDS if until is None else until - time.monotonic()
                await asyncio.sleep(max(min(left, _RETRY_SECONDS), 0.0))
                return None
            case Work(call):
                work: Callable[[], Any] = call
            case Ask():
                work = partial(self._ask, action)
        return await asyncio.get_running_loop().run_in_executor(self._threads, work)

    def _ask(self, query: Ask) -> list[bytes]:
        try:
            return self._transport.query(query.key, query.payload, timeout=query.timeout)
        except TransportError:
            return []
