"""The clients of a gateway as actors of a run. For the gateway's event loop; the learner link has a thread of its own.

event loop        clients' messages, actions, rollouts: this file, connection.py, batcher.py
link thread       finds the learner, loads snapshots: learner_link.py
join threads      requests to join, which may wait
"""

import asyncio
import logging
import secrets
import threading
import time
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from daedalus.actor.session.learner_queries import ActorError, NameInUseError
from daedalus.actor.session.origin import own_origin
from daedalus.actor.session.run_end import RunOverError
from daedalus.actor.session.upload_session import UploadSession
from daedalus.gateway.batcher import Batcher
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_spaces import ClientSpaces
from daedalus.gateway.errors import ClientError
from daedalus.gateway.learner_link import LearnerLink, NewestPolicy
from daedalus.gateway.messages import Act, Hello
from daedalus.gateway.policy_version import PolicyVersion
from daedalus.protocol import keys
from daedalus.protocol.messages import Join, Origin, Welcome
from daedalus.transport.interface import Declaration, Transport, TransportError

_logger = logging.getLogger(__name__)

MAX_CLIENTS = 1024
_JOIN_THREADS = 16
JOIN_SECONDS = 60.0  # for a learner and its first policy to come
_TICK_SECONDS = 0.05
_RETRY_SECONDS = 0.2  # between requests to join
_NAME_IN_USE_SECONDS = 10.0  # until the network notices that an earlier gateway is dead
_PARK_SECONDS, _MAX_PARKED = 60.0, MAX_CLIENTS  # how long a client that disconnected may return to its rollout
# Versions of the policy that clients use at the same time: at least so many, and as many as fit these bytes.
_MIN_VERSIONS, _VERSION_BYTES = 8, 512 << 20
_SLOW_SECONDS = 10.0  # at that limit, a client that is silent for so long loses its unfinished rollout


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayConfig:
    """What a gateway decides for itself."""

    name: str  # of its own requests; it is no actor
    owner: str = ""  # the name in its certificate: clients are OWNER.NAME to the learner; empty without a certificate
    run: str = keys.ANY_RUN

    def actor_name(self, client: str) -> str:
        """Return the name of a client towards the learner. Raises ClientError if there is none."""
        name = f"{self.owner}.{client}" if self.owner else client
        if not keys.is_name(client) or not keys.is_name(name):
            raise ClientError(
                "malformed",
                f"name must be 1 to {64 - len(name) + len(client)} letters, digits, '.', '_' or '-', starting with a "
                "letter or digit",
            )
        return name


@dataclass(slots=True)
class _Seat:
    """An actor of the gateway, while its client is connected."""

    actor: ClientActor
    on_end: Callable[[ClientError | str], None]  # ends its connection, with an error or how the run ended
    presence: Declaration | None = None
    is_joining: bool = False
    since: float = field(default_factory=time.monotonic)  # when it began to join


class Gateway:
    """All clients of one gateway, and the run that they take part in."""

    def __init__(self, transport: Transport, config: GatewayConfig, on_failure: Callable[[Exception], None]) -> None:
        """Construct the gateway in a running event loop.

        Args:
          transport: the network; the caller closes it.
          config: settings.
          on_failure: called on the event loop with what ends the link or the policy: the gateway cannot go on.
        """
        self._transport, self._config, self._on_failure = transport, config, on_failure
        self._loop = asyncio.get_running_loop()
        self._stop = threading.Event()
        self._origin = own_origin(transport)
        join = Join(actor=config.name, incarnation=secrets.randbits(62), origin=self._origin)
        self._link = LearnerLink(transport, join, config.run, self._stop, self)
        self._link.newest_version = lambda: self._newest_version
        self._newest_version = -1  # that an acknowledgement mentioned
        self._joins = ThreadPoolExecutor(_JOIN_THREADS, thread_name_prefix="join")
        self._batcher = Batcher(self._current_policy, on_failure)
        self.session: Welcome | None = None  # of the learner that is followed
        self._policy: PolicyVersion | None = None
        self._next_policy: PolicyVersion | None = None  # that waits for an older one to be released
        self._versions: weakref.WeakSet[PolicyVersion] = weakref.WeakSet()
        self.last_run_end = ""  # how the last run ended, until another begins
        self.followed_run = ""  # name of the run that is or was followed
        self.on_run_change: Callable[[], None] = lambda: None  # called when a learner was found, or a run has ended
        self._seats: dict[str, _Seat] = {}  # by the name towards the learner
        self._admitting = 0
        self._parked: dict[str, tuple[float, ClientActor]] = {}  # by name, the oldest first
        self._news = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._thread = threading.Thread(target=self._run_link, name="learner-link", daemon=True)

    def open(self) -> None:
        """Begin to follow the run."""
        self._thread.start()
        self._start(self._tick())

    async def close(self) -> None:
        """Leave the run. At most about 3 s."""
        self._stop.set()
        for task in list(self._tasks):
            task.cancel()
        for seat in list(self._seats.values()):
            seat.on_end(ClientError("unavailable", "the gateway stops"))
        self._joins.shutdown(wait=False, cancel_futures=True)
        if self._thread.is_alive():
            await asyncio.to_thread(self._thread.join, 3.0)

    @property
    def newest_policy(self) -> NewestPolicy | None:
        """The newest policy as messages; None before the first."""
        return self._link.newest_policy

    def fetch_policy(self) -> None:
        """Ask the learner for a newer policy, although no client has heard of one."""
        self._link.fetch()

    def _start(self, work: Any) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._on_done)

    def _on_done(self, task: "asyncio.Task[None]") -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self._on_failure(error if isinstance(error, Exception) else RuntimeError(str(error)))

    # ------------------------------------------------------------------------------------------- the clients

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._seats)

    async def admit(self, hello: Hello, address: str, on_end: Callable[[ClientError | str], None]) -> ClientActor:
        """Return the actor of a client once it may act. Raises ClientError if it cannot take part.

        Args:
          hello: the client's message.
          address: where the client is, for the status of the run.
          on_end: called if the gateway must end the connection: see connection.py.
        """
        name = self._config.actor_name(hello.name)
        spaces = ClientSpaces(hello.observations, hello.actions)
        if name in self._seats:
            raise ClientError("refused", f"a client named {hello.name!r} is connected: choose another name")
        if len(self._seats) >= MAX_CLIENTS:
            raise ClientError("unavailable", f"{MAX_CLIENTS} clients are connected already: try again later")
        actor = self._returning(name, spaces) or self._new_actor(name, spaces, address)
        seat = self._seats[name] = _Seat(actor, on_end)
        try:
            async with asyncio.timeout(JOIN_SECONDS):
                await self._enter(seat)
        except TimeoutError:
            self.leave(actor)
            missing = "learner" if self.session is None else "policy"
            raise ClientError("unavailable", f"no {missing} came within {JOIN_SECONDS:g} s: try again later") from None
        except BaseException:
            self.leave(actor)
            raise
        return actor

    def _new_actor(self, name: str, spaces: ClientSpaces, address: str) -> ClientActor:
        origin = Origin(host=self._origin.host, software=self._origin.software, address=address)
        join = Join(actor=name, incarnation=secrets.randbits(62), origin=origin)
        return ClientActor(join, spaces, UploadSession(self._transport, name, self._link.presence, self._link.lock))

    def _returning(self, name: str, spaces: ClientSpaces) -> ClientActor | None:
        """Return the actor of a client that was here a moment ago, with the same spaces."""
        _, actor = self._parked.pop(name, (0.0, None))
        if actor is not None and actor.spaces.stated != spaces.stated:
            actor.release()
            return None
        return actor

    async def _enter(self, seat: _Seat) -> None:
        """Join the learner, and wait for a policy of it."""
        while True:
            await self._join_newest(seat)
            while self._is_current(seat):
                if self._policy is not None and self._policy.session is self.session:
                    return
                await self._news.wait()

    def _is_current(self, seat: _Seat) -> bool:
        return self.session is not None and seat.actor.epoch == self.session.learner_epoch

    def _announce(self) -> None:
        self._news.set()
        self._news = asyncio.Event()

    async def _join_newest(self, seat: _Seat) -> None:
        """Join the learner that is there, once there is one. Raises ClientError if the client cannot take part."""
        seat.is_joining = True
        try:
            while (session := self.session) is None or not await self._join(seat, session):
                if session is self.session:
                    await (self._news.wait() if session is None else asyncio.sleep(_RETRY_SECONDS))
        finally:
            seat.is_joining = False

    async def _join(self, seat: _Seat, session: Welcome) -> bool:
        """Ask to join a learner; return whether the client now takes part in the newest session."""
        join, transforms = seat.actor.prepare(session.spec)
        if seat.presence is None:
            key = keys.presence(session.run, join.actor, join.incarnation)
            seat.presence = self._transport.declare_presence(key)
        began = time.monotonic()
        try:
            welcome = await self._ask(session.run, join)
        except NameInUseError as error:
            if began > seat.since + _NAME_IN_USE_SECONDS:
                raise ClientError("refused", str(error)) from None
            return False
        except (ActorError, RunOverError, TransportError) as error:
            raise ClientError("refused", str(error)) from None
        if welcome is None or session is not self.session:
            return False
        if welcome.learner_epoch != session.learner_epoch:
            self._link.look_again()
            return False
        seat.actor.joined(welcome, transforms)  # with the client's own epsilon
        return True

    async def _ask(self, run: str, join: Join) -> Welcome | None:
        return await self._loop.run_in_executor(self._joins, self._link.queries.request_join, run, join)

    def leave(self, actor: ClientActor) -> None:
        """End the episode of a client that disconnected, as truncated. It may return for a minute."""
        seat = self._seats.get(actor.name)
        if seat is None or seat.actor is not actor:
            return
        del self._seats[actor.name]
        self._batcher.remove(actor)
        if seat.presence is not None:
            seat.presence.close()
        actor.cut()
        if actor.epoch >= 0 and not actor.ended_by[0]:
            self._parked[actor.name] = time.monotonic(), actor
            if len(self._parked) > _MAX_PARKED:
                self._forget_parked()

    def _forget_parked(self) -> None:
        """Forget the actor that has been absent longest."""
        _, actor = self._parked.pop(next(iter(self._parked)))
        actor.release()

    async def act(self, actor: ClientActor, message: Act) -> Any:
        """Return a client's action. Raises ClientError if the message does not fit; nothing has changed then."""
        actor.observe(message, self._current_policy())
        actor.chosen = self._loop.create_future()
        self._batcher.add(actor)
        return await actor.chosen

    def _current_policy(self) -> PolicyVersion:
        assert self._policy is not None  # nobody is admitted before
        return self._policy

    # ---------------------------------------------------------------------------------------------- the tick

    async def _tick(self) -> None:
        """Send what is due, and notice what the learner answered, again and again."""
        while True:
            await asyncio.sleep(_TICK_SECONDS)
            now = time.monotonic()
            while self._parked and now > next(iter(self._parked.values()))[0] + _PARK_SECONDS:
                self._forget_parked()
            for _, actor in self._parked.values():
                actor.send()
            for seat in list(self._seats.values()):
                seat.actor.send()
                if self._is_current(seat) and not seat.is_joining:
                    self._newest_version = max(self._newest_version, seat.actor.newest_version)
                    self._obey(seat)
            self._adopt_policy()

    def _obey(self, seat: _Seat) -> None:
        """Act on the verdict that ended an actor's session, if there is one."""
        verdict, reason = seat.actor.ended_by
        if verdict == "quarantined":
            seat.on_end(ClientError("refused", f"the learner quarantined this client: {reason}"))
        elif verdict == "drained":
            seat.on_end(ClientError("refused", "an operator drained this client: it leaves the run"))
        elif verdict == "finished":
            seat.on_end("the run is over")
        elif verdict == "fenced":
            self._link.look_again()

    # ----------------------------------------------------------------------------- the policy, and its learner

    def _adopt_policy(self) -> None:
        """Use the newest version, unless clients still hold too many older ones."""
        version = self._next_policy
        if version is None:
            return
        if len(self._versions) >= max(_MIN_VERSIONS, _VERSION_BYTES // version.size) and self._policy is not None:
            self._drop_slowest()
            return
        self._policy, self._next_policy = version, None
        self._versions.add(version)
        self._announce()

    def _drop_slowest(self) -> None:
        seat = min(self._seats.values(), key=lambda seat: seat.actor.heard_at, default=None)
        if seat is not None and time.monotonic() > seat.actor.heard_at + _SLOW_SECONDS:
            seat.on_end(ClientError("unavailable", "the client is idle, and others wait for its memory"))
        elif self._parked:
            self._forget_parked()

    async def _rejoin(self, seat: _Seat) -> None:
        """Join a learner that has restarted, or that the network had lost."""
        seat.since = time.monotonic()
        try:
            await self._join_newest(seat)
        except ClientError as error:
            seat.on_end(error)

    def _on_learner(self, session: Welcome) -> None:
        other_run = self.session is not None and self.session.run != session.run
        self.session, self.last_run_end, self._newest_version = session, "", -1
        self.followed_run = session.run
        self._announce()
        self.on_run_change()
        for seat in list(self._seats.values()):
            if other_run and seat.presence is not None:
                seat.presence.close()
                seat.presence = None
            if not seat.is_joining:
                self._start(self._rejoin(seat))

    def _on_run_over(self, reason: str) -> None:
        self.session = self._policy = self._next_policy = None
        self.last_run_end = reason
        self.on_run_change()
        while self._parked:
            self._forget_parked()
        self._newest_version = -1
        for seat in list(self._seats.values()):
            seat.on_end(reason)

    def _on_policy(self, version: PolicyVersion) -> None:
        self._next_policy = version
        if self._policy is None or self._policy.session is not version.session:
            self._policy = None
        self._adopt_policy()

    # ------------------------------------------------------------------------------------ on the link's thread

    def _run_link(self) -> None:
        try:
            self._link.run()
        except Exception as error:  # broad: any error, ours too, ends the gateway
            self._post(self._on_failure, error)

    def _post(self, call: Callable[..., object], *arguments: Any) -> None:
        if not self._stop.is_set():
            self._loop.call_soon_threadsafe(call, *arguments)

    def on_learner(self, session: Welcome) -> None:
        """See LinkEvents."""
        self._post(self._on_learner, session)

    def on_policy(self, version: PolicyVersion) -> None:
        """See LinkEvents."""
        self._post(self._on_policy, version)

    def on_learner_lost(self, reason: str) -> None:
        """See LinkEvents. The clients act on with the last policy."""

    def on_run_over(self, reason: str) -> None:
        """See LinkEvents."""
        self._post(self._on_run_over, reason)
