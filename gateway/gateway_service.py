"""One gateway, from its first connection to its end: the web server, the clients' actors and the page of the run.

The web server answers before the network is reached: clients wait, and the page says so.
"""

import asyncio
import gc
import logging
import os
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

from daedalus.gateway.app import application
from daedalus.gateway.client_gateway import Gateway, GatewayConfig
from daedalus.gateway.client_messages import ClientError
from daedalus.gateway.security import LOOPBACK, OperatorToken, Tokens, guard
from daedalus.gateway.server import Server, tls_context
from daedalus.gateway.watching.camera import CameraProcess
from daedalus.gateway.watching.learner_source import LearnerSource
from daedalus.gateway.watching.monitor import RunMonitor
from daedalus.gateway.watching.page_data import Observation, OtherRun, PageData, ReadFolder
from daedalus.gateway.watching.person_matches import Matches
from daedalus.gateway.watching.playing_process import PolicySource
from daedalus.protocol.codec import ProtocolError
from daedalus.protocol.messages import Order
from daedalus.transport.addresses import bracketed
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import Credentials
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.operator_orders import Operator
from daedalus.transport.retries import Retries

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.2
_FORBIDDEN = (
    "this gateway connects with the certificate of an actor, which may not read the status of the run: start it with "
    "--operator certs/operator too"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewaySettings:
    """What the command line decides."""

    connect: list[str]  # addresses of the network
    shown_host: str  # where clients connect, as the user wrote it
    run: str
    credentials: Credentials | None = None  # of an actor
    operator: Credentials | None = None  # of an operator, to read the status
    serving: Credentials | None = None  # of the web server
    hosts: list[str] = field(default_factory=list)  # further names of this gateway
    origins: list[str] = field(default_factory=list)  # of pages that may connect
    operator_token: OperatorToken | None = None
    takes_clients: bool = True  # or the page only
    record: str = ""  # the dataset of the clients' episodes
    other_runs: Callable[[], list[OtherRun]] = lambda: []
    read_folder: ReadFolder = lambda run: None
    camera: tuple[str, ...] | None = None  # command of the camera's process; None: no camera
    match: tuple[str, ...] | None = None  # the same of a person's match against the policy
    announce: Callable[[str], None] | None = None  # receives the address of the page, instead of the log


class GatewayService:
    """The parts of one gateway. Construct it in a running event loop."""

    def __init__(self, settings: GatewaySettings, stop: threading.Event) -> None:
        """`stop` ends the gateway."""
        self._settings, self._stop = settings, stop
        self._loop = asyncio.get_running_loop()
        self._ended, self._failures = asyncio.Event(), list[Exception]()
        self._gateway: asyncio.Future[Gateway] = self._loop.create_future()
        self._monitor: RunMonitor | None = None
        self._policies = PolicySource()
        self._camera = None if settings.camera is None else CameraProcess(settings.camera, self._policies)
        self._matches = None if settings.match is None else Matches(settings.match, self._policies)
        self._data = PageData(settings.other_runs, self._camera, self._matches, takes_clients=settings.takes_clients)
        self._transports = ExitStack()
        owner = settings.credentials.name if settings.credentials else ""
        name = f"{owner or 'gateway'}.gateway-{os.getpid()}"
        self._config = GatewayConfig(name=name, owner=owner, run=settings.run, record=settings.record)

    async def run(self, listener: socket.socket) -> None:
        """Serve until `stop` is set. Raises what makes the gateway fail."""
        gc.collect()
        gc.freeze()  # the modules: a full collection would else take 50 ms, for which all clients wait
        settings, port = self._settings, listener.getsockname()[1]
        tokens = None if settings.serving is None else Tokens(settings.serving.directory)
        tls = None if settings.serving is None else tls_context(settings.serving.directory)
        certified = [] if settings.serving is None else list(map(bracketed, settings.serving.hosts()))
        names = [*LOOPBACK, *settings.hosts, *certified, socket.gethostname()]
        # Whoever reaches a plain TCP address may ask its learner for the status: the page may show it to everybody.
        openly = settings.operator is None and all(address.startswith("tcp/") for address in settings.connect)
        rules = guard(names, port, settings.origins, tokens, settings.operator_token, reads_openly=openly)
        where, secure = f"{settings.shown_host}:{port}", "s" if tls else ""
        if settings.takes_clients:
            _logger.info("clients connect to ws%s://%s/actor", secure, where)
        if settings.announce is None:
            _logger.info("the page of the run is at http%s://%s/", secure, where)
        else:
            settings.announce(f"http{secure}://{where}/")
        tasks = [asyncio.create_task(self._await_stop()), asyncio.create_task(self._reach_network())]
        try:
            await Server(application(self._gateway, rules, self._data), tls).run_until(
                self._ended, listener, self._close
            )
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.to_thread(self._transports.close)
        if self._failures:
            raise self._failures[0]

    def _fail(self, error: Exception) -> None:
        self._failures.append(error)
        self._ended.set()

    async def _await_stop(self) -> None:
        while not self._stop.is_set():
            await asyncio.sleep(_POLL_SECONDS)
        self._ended.set()

    async def _reach_network(self) -> None:
        try:
            transport = await self._connect(self._settings.credentials)
            if transport is None:
                return
            gateway = Gateway(transport, self._config, self._fail)
            gateway.open()
            self._gateway.set_result(gateway)
            self._policies.newest, self._policies.fetch = lambda: gateway.newest_policy, gateway.fetch_policy
            watching = transport
            if self._settings.operator is not None:
                watching = await self._connect(self._settings.operator)
            elif self._settings.credentials is not None:
                self._data.show(Observation(state="forbidden", reason=_FORBIDDEN))
                return
            if watching is not None:
                self._begin_to_watch(watching, gateway)
        except Exception as error:  # broad: any error, ours too, ends the gateway
            self._fail(error)

    async def _connect(self, credentials: Credentials | None) -> Transport | None:
        """Return a transport once the network is reached, or None if stopped before."""
        transport = await asyncio.to_thread(self._await_network, credentials)
        if transport is not None:
            self._transports.callback(transport.close)
        return transport

    def _await_network(self, credentials: Credentials | None) -> Transport | None:
        """See _connect. A certificate that is refused may be renewed, here or at the router."""
        retries = Retries(self._stop)
        while True:
            try:
                return connect_with_retry(self._settings.connect, self._stop, None, credentials)
            except TransportError as error:
                if retries.wait(str(error)):
                    return None

    def _begin_to_watch(self, transport: Transport, gateway: Gateway) -> None:
        operator = Operator.here(self._settings.operator)
        source = LearnerSource(transport, self._settings.run, lambda: gateway.run.name, operator)

        def show(seen: Observation) -> None:
            if not self._stop.is_set():
                self._loop.call_soon_threadsafe(self._data.show, seen)

        def give(order: Order, token: str) -> tuple[bool, str]:
            status = self._data.seen.status
            if status is None:
                return False, "no learner has answered yet"
            try:
                return source.order(status, order, token)
            except (TransportError, ProtocolError) as error:
                return False, str(error)

        self._monitor = RunMonitor(source, show, lambda: gateway.run.last_end, self._settings.read_folder)
        gateway.run.on_change = self._monitor.look
        self._data.on_watch, self._data.give_order = self._monitor.watch, give
        self._monitor.watch(self._data.is_watched)
        self._monitor.open()

    async def _close(self) -> None:
        """Close all parts side by side: each may wait for some seconds."""
        closing = [self._close_gateway(), self._close_page()]
        closing += [part.close() for part in (self._camera, self._matches) if part is not None]
        await asyncio.gather(*closing)

    async def _close_page(self) -> None:
        """Leave the pages that are open with the end of the run."""
        if self._monitor is None:
            return
        await asyncio.to_thread(self._monitor.close)
        await self._data.close(await asyncio.to_thread(self._monitor.last_look))

    async def _close_gateway(self) -> None:
        if self._gateway.done():
            await self._gateway.result().close()
        else:
            self._gateway.set_exception(ClientError("unavailable", "the gateway stops"))
            self._gateway.exception()  # read, whether or not a client waits
