"""The clients of a gateway as actors of a run. For the gateway's event loop; what may wait has threads of its own.

event loop        clients' messages, actions, rollouts: this file, connection.py, batcher.py, client_uploads.py
link thread       finds the learner, loads snapshots: learner_link.py
join threads      requests to join, which may wait: joining.py
presence thread   declares which clients are present: joining.py
sender thread     sends the rollouts: client_uploads.py
"""

import asyncio
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from daedalus.actor.collecting.loop_recorder import LoopRecorder
from daedalus.actor.session.actor_config import ActorConfig, own_origin
from daedalus.gateway.batcher import Batcher
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_messages import Act, ClientError, Hello
from daedalus.gateway.client_spaces import ClientSpaces
from daedalus.gateway.client_uploads import ClientUploads, Outbox, Sender
from daedalus.gateway.joining import FollowedRun, Joining, Seat
from daedalus.gateway.learner_link import LearnerLink, LinkSession, NewestPolicy
from daedalus.gateway.policy_versions import PolicyVersion, PolicyVersions
from daedalus.protocol import keys
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.messages import Join, Origin, Welcome
from daedalus.transport.interface import Transport


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayConfig:
    """What a gateway decides for itself."""

    name: str  # of its own requests; it is no actor
    owner: str = ""  # the name in its certificate: clients are OWNER.NAME to the learner; empty without a certificate
    run: str = keys.ANY_RUN
    record: str = ""  # the dataset of the clients' episodes; empty: none

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


_SECONDS = 60.0  # for which a client may return


class ParkedActors:
    """Up to a number of actors; the one that has been absent longest goes first."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._actors: dict[str, tuple[float, ClientActor]] = {}  # by name, the oldest first

    def __iter__(self) -> Iterator[ClientActor]:
        return (actor for _, actor in self._actors.values())

    def park(self, actor: ClientActor) -> None:
        """Keep an actor whose client has disconnected."""
        self._actors[actor.name] = time.monotonic(), actor
        if len(self._actors) > self._most:
            self.release_oldest()

    def take(self, name: str, spaces: ClientSpaces) -> ClientActor | None:
        """Return the actor of a client that returns with the same spaces."""
        _, actor = self._actors.pop(name, (0.0, None))
        if actor is not None and actor.spaces.stated != spaces.stated:
            actor.release()
            return None
        return actor

    def release_oldest(self) -> None:
        """Release the actor that has been absent longest, if there is one."""
        if self._actors:
            _, actor = self._actors.pop(next(iter(self._actors)))
            actor.release()

    def release_late(self, now: float) -> None:
        """Release those that did not return in time."""
        while self._actors and now > next(iter(self._actors.values()))[0] + _SECONDS:
            self.release_oldest()

    def clear(self) -> None:
        """Release all."""
        while self._actors:
            self.release_oldest()


MAX_CLIENTS = 1024
JOIN_SECONDS = 60.0  # for a learner and its first policy to come
_LINK_SECONDS, _SENDER_SECONDS = 2.0, 1.0  # for the threads to end
_TICK_SECONDS = 0.05
_SLOW_SECONDS = 10.0  # where versions need memory, a client that is silent for so long loses its unfinished rollout


class Gateway:
    """All clients of one gateway, and the run that they take part in."""

    def __init__(self, transport: Transport, config: GatewayConfig, on_failure: Callable[[Exception], None]) -> None:
        """Construct the gateway in a running event loop.

        Args:
          transport: the network; the caller closes it.
          config: settings.
          on_failure: called on the event loop with a fault of ours: the gateway cannot go on.

        Raises DatasetError if the dataset exists, or Minari is not installed.
        """
        self._recorder = LoopRecorder(config.record) if config.record else None
        self._transport, self._config, self._on_failure = transport, config, on_failure
        self._loop = asyncio.get_running_loop()
        self._stop = threading.Event()
        self._origin = own_origin(transport)
        incarnation = secrets.randbits(62)
        link = ActorConfig(name=config.name, incarnation=incarnation, run=config.run, any_run=True, link="lan")
        self._link_session = LinkSession(link, self._origin)
        self._link = LearnerLink(self._link_session, transport, self._stop, self)
        self._newest_version = -1  # that an acknowledgement mentioned
        self.run = FollowedRun()
        self._joining = Joining(transport, self._link, self.run)
        self._versions = PolicyVersions()
        self._seats: dict[str, Seat] = {}  # by the name towards the learner
        self._batcher = Batcher(
            lambda: self._versions.current, lambda: len(self._seats), self._link.fail, self._on_fault
        )
        self._outbox = Outbox()
        self._sender = Sender(transport, lambda error: self._post(on_failure, error))
        self._parked = ParkedActors(MAX_CLIENTS)
        self._tasks: set[asyncio.Task[None]] = set()
        self._thread = threading.Thread(target=self._run_link, name="learner-link", daemon=True)

    def open(self) -> None:
        """Begin to follow the run."""
        self._thread.start()
        self._sender.open()
        self._start(self._tick())

    async def close(self) -> None:
        """Leave the run. At most about 3 s."""
        self._stop.set()
        try:
            for task in list(self._tasks):
                task.cancel()
            for seat in list(self._seats.values()):
                seat.on_end(ClientError("unavailable", "the gateway stops"))
            self._joining.close()
        finally:
            await asyncio.to_thread(self._close_threads)

    def _close_threads(self) -> None:
        try:
            if self._thread.is_alive():
                self._thread.join(_LINK_SECONDS)
        finally:
            self._sender.close(_SENDER_SECONDS)  # the clients' last rollouts may have come meanwhile
            if self._recorder is not None:
                self._recorder.close(_LINK_SECONDS)

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

    async def admit(
        self, hello: Hello, address: str, on_end: Callable[[ClientError | str], None]
    ) -> dict[str, ClientActor]:
        """Return the actor of each seat of a client, once all may act. Raises ClientError if it cannot take part.

        A client without a match has one actor, under the empty name. That of a seat is called NAME.SEAT.

        Args:
          hello: the client's message.
          address: where the client is, for the status of the run.
          on_end: called if the gateway must end the connection: see connection.py.
        """
        if self._stop.is_set():
            raise ClientError("unavailable", "the gateway stops")
        spaces = ClientSpaces(hello.observations, hello.actions)
        names = {self._config.actor_name(hello.name): ""}
        if hello.match:
            names = {self._config.actor_name(f"{hello.name}.{name}"): name for name in hello.match[0].seats}
        if names.keys() & self._seats.keys():
            # It may be the same client, whose connection was lost without a word: pings end it soon.
            reason = f"a client named {hello.name!r} is connected: choose another name, or try again in 20 s"
            raise ClientError("unavailable", reason)
        actors: dict[str, ClientActor] = {}
        try:
            for number, (name, seat) in enumerate(names.items()):
                actor = self._parked.take(name, spaces) or self._new_actor(name, spaces, address)
                actor.seat = hello.match[number] if hello.match else None
                self._seats[name] = Seat(actor, on_end, self._joining.presence())
                actors[seat] = actor
            async with asyncio.timeout(JOIN_SECONDS):
                for name in names:
                    await self._enter(self._seats[name])
        except TimeoutError:
            self.leave(actors)
            missing = "learner" if self.run.session is None else "policy"
            raise ClientError("unavailable", f"no {missing} came within {JOIN_SECONDS:g} s: try again later") from None
        except BaseException:
            self.leave(actors)
            raise
        return actors

    def _new_actor(self, name: str, spaces: ClientSpaces, address: str) -> ClientActor:
        origin = Origin(host=self._origin.host, software=self._origin.software, address=address)
        join = Join(actor=name, incarnation=secrets.randbits(62), origin=origin)
        uploads = ClientUploads(join, self._sender, self._link_session.heard, self._outbox.add)
        actor = ClientActor(join, spaces, uploads)
        if self._recorder is not None:
            actor.tape = self._recorder.tape(spaces.observation_space, spaces.action_space)
        return actor

    async def _enter(self, seat: Seat) -> None:
        """Join the learner, and wait for a policy of it."""
        while True:
            await self._joining.join(seat)
            while seat.is_in(self.run.session):
                if self._versions.of(self.run.session) is not None:
                    return
                await self.run.change()

    def leave(self, actors: Mapping[str, ClientActor]) -> None:
        """End the episodes of a client that disconnected, as truncated. It may return for a minute."""
        for actor in actors.values():
            self._leave(actor)

    def _leave(self, actor: ClientActor) -> None:
        seat = self._seats.get(actor.name)
        if seat is None or seat.actor is not actor:
            return
        del self._seats[actor.name]
        self._batcher.remove(actor)
        seat.presence.withdraw()
        actor.cut()
        if actor.epoch >= 0 and not actor.uploads.ended_by[0]:
            self._parked.park(actor)

    def parameters(self, actor: ClientActor) -> Parameters:
        """Return the parameters of the environment in a client's next episode. Raises ClientError."""
        return actor.parameters(self._versions.current)

    def act(self, actor: ClientActor, message: Act, on_action: Callable[[Any], None]) -> None:
        """Choose a client's action, and call `on_action` with it, soon.

        Raises ClientError if the message does not fit; nothing has changed then.
        """
        actor.observe(message, self._versions.current, on_action)
        self._batcher.add(actor)

    def _on_fault(self, actor: ClientActor, error: Exception) -> None:
        seat = self._seats.get(actor.name)
        if seat is not None and seat.actor is actor:
            seat.on_end(
                ClientError("refused", f"the gateway failed on an action ({type(error).__name__}): see its log")
            )

    # ---------------------------------------------------------------------------------------------- the tick

    async def _tick(self) -> None:
        """Send what is due, and notice what the learner answered, again and again."""
        while True:
            await asyncio.sleep(_TICK_SECONDS)
            self._parked.release_late(time.monotonic())
            for actor in self._parked:
                self._send_due(actor)
            for seat in list(self._seats.values()):
                self._send_due(seat.actor)
                if seat.is_in(self.run.session) and not seat.is_joining:
                    self._mention(seat.actor)
                    self._obey(seat)
            self._adopt_policy()

    def _mention(self, actor: ClientActor) -> None:
        """Tell the link of the newest version that an acknowledgement mentioned."""
        version = actor.uploads.newest_version
        if version > self._newest_version:
            self._newest_version = version
            self._link.mention(actor.epoch, version)

    def _send_due(self, actor: ClientActor) -> None:
        actor.uploads.send_due()
        if actor.uploads.can_send:
            self._outbox.add(actor.uploads)

    def _obey(self, seat: Seat) -> None:
        """Act on the verdict that ended an actor's session, if there is one."""
        verdict, reason = seat.actor.uploads.ended_by
        if verdict == "quarantined":
            seat.on_end(ClientError("refused", f"the learner quarantined this client: {reason}"))
        elif verdict == "drained":
            seat.on_end(ClientError("refused", f"{reason or 'drained by an operator'}: this client leaves the run"))
        elif verdict == "finished":
            seat.on_end("the run is over")
        elif verdict == "fenced":
            self._link.look_again()

    def _adopt_policy(self) -> None:
        """Use the newest version, unless clients still hold too many older ones."""
        if self._versions.is_full:
            self._drop_slowest()
        elif self._versions.adopt():
            self.run.announce()

    def _drop_slowest(self) -> None:
        holders = [seat for seat in self._seats.values() if seat.actor.version is not None]
        seat = min(holders, key=lambda seat: seat.actor.heard_at, default=None)
        if seat is not None and time.monotonic() > seat.actor.heard_at + _SLOW_SECONDS:
            seat.on_end(ClientError("unavailable", "the client is idle, and others wait for its memory"))
        else:
            self._parked.release_oldest()

    # ------------------------------------------------------------------------- what the link's thread reports

    def _on_learner(self, session: Welcome) -> None:
        other_run = self.run.session is not None and self.run.session.run != session.run
        self._newest_version = -1
        self.run.begin(session)
        for seat in list(self._seats.values()):
            if other_run:
                seat.presence.withdraw()
            if not seat.is_joining:
                self._start(self._joining.rejoin(seat))

    def _on_run_over(self, end: ClientError | str) -> None:
        self._versions.clear()
        self.run.end(end if isinstance(end, str) else "")
        self._parked.clear()
        self._newest_version = -1
        for seat in list(self._seats.values()):
            self._batcher.remove(seat.actor)
            seat.on_end(end)

    def _on_policy(self, version: PolicyVersion) -> None:
        self._versions.offer(version)
        self._adopt_policy()

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

    def on_run_over(self, reason: str) -> None:
        """See LinkEvents."""
        self._post(self._on_run_over, reason)

    def on_failure(self, reason: str) -> None:
        """See LinkEvents."""
        self._post(self._on_run_over, ClientError("unavailable", reason))
