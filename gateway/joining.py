"""Lets clients take part in the run: requests to join its learner. For the gateway's event loop, with threads."""

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from daedalus.actor.errors import ActorError, NameInUseError
from daedalus.actor.session.run_end import RunOverError
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_messages import ClientError
from daedalus.gateway.followed_run import FollowedRun
from daedalus.gateway.learner_link import LearnerLink
from daedalus.gateway.presence import Presence
from daedalus.protocol import keys
from daedalus.protocol.messages import Join, Welcome
from daedalus.transport.interface import Transport, TransportError

_THREADS = 16  # requests at the same time, which may wait
_RETRY_SECONDS = 0.2  # between requests of one client
_NAME_IN_USE_SECONDS = 10.0  # until the network notices that an earlier gateway is dead


@dataclass(slots=True)
class Seat:
    """An actor of the gateway, while its client is connected."""

    actor: ClientActor
    on_end: Callable[[ClientError | str], None]  # ends its connection, with an error or how the run ended
    presence: Presence
    is_joining: bool = False
    since: float = field(default_factory=time.monotonic)  # when it began to join

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
        seat.since = time.monotonic()
        try:
            await self.join(seat)
        except ClientError as error:
            seat.on_end(error)

    async def _join(self, seat: Seat, session: Welcome) -> bool:
        """Ask the learner of a session again and again; return False once another learner is followed, or none."""
        join, transforms = seat.actor.prepare(session.spec)
        while session is self._run.session:
            welcome = await self._ask(seat, session, join)
            if welcome is not None:
                seat.actor.joined(welcome, transforms)  # with the client's own epsilon
                return True
            if session is self._run.session:
                await asyncio.sleep(_RETRY_SECONDS)
        return False

    async def _ask(self, seat: Seat, session: Welcome, join: Join) -> Welcome | None:
        """Ask to join a learner; return its answer if the client now takes part in the newest session."""
        began = time.monotonic()
        request = self._link.queries.request_join
        try:
            await seat.presence.declare(keys.presence(session.run, join.actor, join.incarnation))
            welcome = await asyncio.get_running_loop().run_in_executor(self._threads, request, session.run, join)
        except NameInUseError as error:
            if began > seat.since + _NAME_IN_USE_SECONDS:
                raise ClientError("refused", str(error)) from None
            return None
        except (ActorError, RunOverError, TransportError) as error:
            raise ClientError("refused", str(error)) from None
        if welcome is None or session is not self._run.session:
            return None
        if welcome.learner_epoch != session.learner_epoch:
            self._link.look_again()
            return None
        return welcome
