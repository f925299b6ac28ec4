"""The process of `daedalus exporter`: a learner's status as Prometheus metrics, and the HTTP server for them.

A counter that a learner restores from a checkpoint goes back a little. Prometheus interprets this as a restart from 0,
so `rate` shows a peak of the whole count. Rates that the dashboard draws are therefore also exported as gauges.
"""

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from socketserver import ThreadingMixIn
from typing import Any, cast
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from daedalus.launch.logs import print_error
from daedalus.launch.process_lifecycle import FAILED
from daedalus.protocol import keys
from daedalus.protocol.messages import ActorStatus, RunStatus
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import Credentials, certificate_days_left, run_for
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.retries import Retries
from daedalus.transport.slow_calls import SlowCall
from daedalus.transport.status_query import Survey, newest_of_each_run, survey
from daedalus.transport.zenoh_session import PeerCertificate, peer_certificate

_logger = logging.getLogger(__name__)

_MAX_ACTORS = 1000  # of a run with series of their own
_DAY = 86_400.0
_LISTENER_SECONDS = 300.0  # between looks at the certificate of each listener
_KEPT_SECONDS, _MAX_RUNS = 7 * _DAY, 1000  # what is remembered of the certificates of learners that have gone
_REOPEN_SECONDS = 10.0  # after this time without an answer, a new session replaces the old one


_QUIET_SECONDS = 10.0  # a connection that sends or takes nothing for as long is ended
_MAX_CONNECTIONS = 64  # each has a thread


class _Handler(WSGIRequestHandler):
    """Handler that waits for a limited time, and logs no requests."""

    timeout = _QUIET_SECONDS

    def parse_request(self) -> bool:
        """Note that the connection is not a silent one."""
        cast(MetricsServer, self.server).asked(self.connection)
        return super().parse_request()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


class MetricsServer(ThreadingMixIn, WSGIServer):
    """Server with a thread for each connection.

    Beyond the limit, the oldest connection without a request is ended, and the oldest of all if each has one.
    """

    daemon_threads = True

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        """Listen. `serve_forever` serves until `shutdown`. Raises OSError."""
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family = family
        self._open: dict[socket.socket, bool] = {}  # whether a request has come; oldest first
        self._lock = threading.Lock()
        super().__init__((str(address[0]), port), _Handler)
        self.set_app(make_wsgi_app(registry))

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread."""
        with self._lock:
            if len(self._open) >= _MAX_CONNECTIONS:
                oldest = next((one for one, has_asked in self._open.items() if not has_asked), next(iter(self._open)))
                del self._open[oldest]
                with contextlib.suppress(OSError):  # it has ended
                    oldest.shutdown(socket.SHUT_RDWR)  # its thread notices, and closes it
            self._open[request] = False
        super().process_request(request, client_address)

    def asked(self, connection: socket.socket) -> None:
        """Note that a connection has sent a request."""
        with self._lock:
            if connection in self._open:
                self._open[connection] = True

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that has left or was too slow."""


def _known_rate(run: RunStatus, rate: float) -> float | None:
    """Return a rate, or None while the first batch is awaited: 0 means that no update comes any more."""
    return rate or (0.0 if run.problems else None)


_Family = type[CounterMetricFamily] | type[GaugeMetricFamily]

_OF_A_RUN: tuple[tuple[_Family, str, str, Callable[[RunStatus], float | None]], ...] = (
    (GaugeMetricFamily, "healthy", "1 if the learner reports no problem, else 0.", lambda run: not run.problems),
    (GaugeMetricFamily, "uptime_seconds", "Age of the learner process.", lambda run: run.uptime_seconds),
    (CounterMetricFamily, "env_steps", "Environment steps that were trained on.", lambda run: run.env_steps),
    (
        GaugeMetricFamily,
        "env_steps_budget",
        "Budget of environment steps of the run.",
        lambda run: run.env_steps_budget,
    ),
    (
        GaugeMetricFamily,
        "env_steps_per_second",
        "Recent environment steps per second.",
        lambda run: _known_rate(run, run.env_steps_per_second),
    ),
    (CounterMetricFamily, "updates", "Optimiser steps.", lambda run: run.updates),
    (
        GaugeMetricFamily,
        "updates_per_second",
        "Recent optimiser steps per second.",
        lambda run: _known_rate(run, run.updates_per_second),
    ),
    (CounterMetricFamily, "updates_skipped", "Updates skipped: gradient not finite.", lambda run: run.updates_skipped),
    (
        GaugeMetricFamily,
        "episode_return_mean",
        "Mean return of the newest episodes.",
        lambda run: run.episode_return_mean,
    ),
    (
        GaugeMetricFamily,
        "rating",
        "Rating of the newest policy in a game with opponents.",
        lambda run: run.league.newest.rating if run.league and run.league.newest else None,
    ),
    (
        GaugeMetricFamily,
        "learning_share",
        "Recent share of the time in which the learner computed updates.",
        lambda run: run.learning_share,
    ),
    (
        GaugeMetricFamily,
        "decoding_share",
        "Recent share of the time in which the learner decoded rollouts.",
        lambda run: run.decoding_share,
    ),
    (GaugeMetricFamily, "policy_lag_updates", "Recent mean policy lag.", lambda run: run.policy_lag_mean),
    (CounterMetricFamily, "rollouts_accepted", "Rollouts accepted.", lambda run: run.rollouts_accepted),
    (CounterMetricFamily, "rollouts_missed", "Rollouts that never arrived.", lambda run: run.rollouts_missed),
    (CounterMetricFamily, "busy_answers", "Rollouts answered with busy.", lambda run: run.busy_answers),
    (GaugeMetricFamily, "queue_bytes", "Bytes of rollouts in the queue.", lambda run: run.queue_bytes),
    (GaugeMetricFamily, "queue_limit_bytes", "Actors get the answer busy above it.", lambda run: run.queue_bytes_limit),
    (
        GaugeMetricFamily,
        "checkpoint_age_seconds",
        "Age of the newest checkpoint.",
        lambda run: run.checkpoint_age_seconds,
    ),
)

_OF_AN_ACTOR: tuple[tuple[_Family, str, str, Callable[[ActorStatus], float]], ...] = (
    (CounterMetricFamily, "actor_lives", "Processes that joined under this name.", lambda actor: actor.lives),
    (
        GaugeMetricFamily,
        "actor_silence_seconds",
        "Time since the last sign of life of the actor: a rollout or a report.",
        lambda actor: actor.seconds_since_seen,
    ),
    (
        GaugeMetricFamily,
        "actor_silence_limit_seconds",
        "Silence above it is unusual for this actor.",
        lambda actor: actor.silence_limit_seconds,
    ),
    (
        GaugeMetricFamily,
        "actor_rollout_seconds",
        "Duration of one of its newest rollouts; 0: unknown.",
        lambda actor: actor.rollout_seconds,
    ),
    (
        GaugeMetricFamily,
        "actor_waiting_seconds",
        "Its wait from one rollout to the next.",
        lambda actor: actor.waiting_seconds,
    ),
    (
        GaugeMetricFamily,
        "actor_round_trip_seconds",
        "Round trip of a small request; 0: unknown.",
        lambda actor: actor.round_trip_seconds,
    ),
    (GaugeMetricFamily, "actor_environments", "Environments of the actor.", lambda actor: actor.environments),
    (
        CounterMetricFamily,
        "actor_env_steps",
        "Environment steps of the actor that were trained on.",
        lambda actor: actor.env_steps,
    ),
    (
        GaugeMetricFamily,
        "actor_env_steps_per_second",
        "Recent env_steps per second.",
        lambda actor: actor.env_steps_per_second,
    ),
    (CounterMetricFamily, "actor_rollouts_accepted", "Rollouts accepted.", lambda actor: actor.rollouts_accepted),
    (CounterMetricFamily, "actor_rollouts_missed", "Rollouts that never arrived.", lambda actor: actor.rollouts_missed),
    (CounterMetricFamily, "actor_busy_answers", "Rollouts answered with busy.", lambda actor: actor.busy_answers),
    (
        GaugeMetricFamily,
        "actor_up_bytes_per_second",
        "Bytes of rollouts per second.",
        lambda actor: actor.bytes_up_per_hour / 3600,
    ),
    (
        GaugeMetricFamily,
        "actor_down_bytes_per_second",
        "Bytes of snapshots per second.",
        lambda actor: actor.bytes_down_per_hour / 3600,
    ),
    (
        GaugeMetricFamily,
        "actor_policy_lag_updates",
        "Policy lag of its newest rollout.",
        lambda actor: actor.policy_lag,
    ),
)


def metrics(statuses: Iterable[RunStatus], unread: Iterable[str] = ()) -> Iterator[Metric]:
    """Yield all metrics of the runs that answered, or only `daedalus_up` 0 if no run answered.

    `unread` are runs whose learners answered, but cannot be read: they have one metric.

    Actors that are gone have no series of their own. They are only counted, by their state, and after a minute only in
    the counters of the run. Of several learners of one run, the newest has series.
    """
    statuses = list(statuses)
    runs = newest_of_each_run(statuses)
    yield GaugeMetricFamily("daedalus_up", "1 if a learner answers, else 0.", value=bool(runs))
    others = GaugeMetricFamily("daedalus_unreadable", "1 for a run whose learner cannot be read.", labels=["run"])
    for name in unread:
        others.add_metric([name], 1)
    yield others
    info = GaugeMetricFamily(
        "daedalus_run_info", "Environment and algorithm of the run.", labels=["run", "environment", "algorithm"]
    )
    releases = GaugeMetricFamily(
        "daedalus_release_processes", "Processes of the run by release.", labels=["run", "role", "software"]
    )
    learners = GaugeMetricFamily("daedalus_learners", "Learners of the run that answer.", labels=["run"])
    actors = GaugeMetricFamily("daedalus_actors", "Actors by state.", labels=["run", "state"])
    rejected = CounterMetricFamily("daedalus_rollouts_rejected", "Rejected rollouts by cause.", labels=["run", "cause"])
    wins = GaugeMetricFamily(
        "daedalus_win_rate", "Win rate of the newest policy against a fixed opponent.", labels=["run", "opponent"]
    )
    for run in runs:
        for opponent, rate in (run.league.win_rates if run.league else {}).items():
            wins.add_metric([run.run, opponent], rate)
        info.add_metric([run.run, run.environment, run.algorithm], 1)
        learners.add_metric([run.run], sum(status.run == run.run for status in statuses))
        for software, counts in run.releases.items():
            for role, count in zip(("learner", "actor"), counts, strict=True):
                if count:
                    releases.add_metric([run.run, role, software], count)
        for state, count in _states(run).items():
            actors.add_metric([run.run, state], count)
        for cause, count in sorted(run.rollouts_rejected.items()):
            rejected.add_metric([run.run, cause], count)
    yield from (info, releases, learners, actors, rejected, wins)
    for kind, name, text, value_of in _OF_A_RUN:
        family = kind(f"daedalus_{name}", text, labels=["run"])
        for run in runs:
            if (value := value_of(run)) is not None:
                family.add_metric([run.run], value)
        yield family
    for kind, name, text, value_of in _OF_AN_ACTOR:
        family = kind(f"daedalus_{name}", text, labels=["run", "actor"])
        for run in runs:
            for actor in run.actors:
                if actor.alive:
                    family.add_metric([run.run, actor.actor], value_of(actor))
        yield family


def _states(run: RunStatus) -> dict[str, int]:
    return {"alive": run.actors_alive, "quarantined": run.actors_quarantined, "gone": run.actors_gone}


class CertificateDays:
    """Days until the certificates of a network expire: of learners, of those that listen, and of this exporter."""

    def __init__(self, endpoints: list[str], credentials: Credentials | None) -> None:
        self._endpoints = [] if credentials is None else endpoints
        self._credentials = credentials
        self._learners: dict[str, tuple[float, float]] = {}  # by run: the days left, and when the learner said so
        self._listeners: dict[str, PeerCertificate] = {}  # by address

    def follow(self, stop: threading.Event) -> None:
        """Look at the certificates of the listeners from time to time, until `stop` is set."""
        while self._credentials is not None:
            for endpoint in self._endpoints:
                found = peer_certificate(endpoint, self._credentials)
                if found is not None:  # else the one seen last is the one that may have expired
                    self._listeners[endpoint] = found
            if stop.wait(_LISTENER_SECONDS if len(self._listeners) == len(self._endpoints) else _REOPEN_SECONDS):
                return

    def metric(self, runs: Iterable[RunStatus]) -> Metric:
        """Return the days as one metric; those of a learner also for a week after it has gone."""
        now = time.monotonic()
        for run in runs:
            if run.certificate_days_left is not None:
                self._learners.pop(run.run, None)
                self._learners[run.run] = run.certificate_days_left, now
        self._learners = {
            run: known for run, known in list(self._learners.items())[-_MAX_RUNS:] if now < known[1] + _KEPT_SECONDS
        }
        family = GaugeMetricFamily(
            "daedalus_certificate_days_left",
            "Days until a certificate expires; negative if it has expired.",
            labels=["run", "role", "address"],
        )
        for run, (days, said) in sorted(self._learners.items()):
            family.add_metric([run, "learner", ""], days - (now - said) / _DAY)
        for endpoint, listener in sorted(self._listeners.items()):
            family.add_metric(["", listener.common_name, endpoint], listener.validity.days_left())
        if (own := certificate_days_left(self._credentials)) is not None:
            family.add_metric(["", "exporter", ""], own)
        return family


class StatusCollector:
    """Collector that queries the learners at each scrape. The timeout of the query bounds the time of a scrape."""

    def __init__(self, certificates: CertificateDays | None = None, run: str = keys.ANY_RUN) -> None:
        """Construct the collector of a run, or of all; `certificates` are those to report too."""
        self._certificates, self._run = certificates or CertificateDays([], None), run
        self.transport: Transport | None = None  # None until a router answers
        self.unanswered = False  # whether no learner answered the last scrape
        self._warned = False  # that not all actors have series

    def collect(self) -> Iterator[Metric]:
        """Query the learners and return their metrics."""
        found = Survey(statuses=[], unread={})
        if self.transport is not None:
            with contextlib.suppress(TransportError):
                found = survey(self.transport, self._run, max_actors=_MAX_ACTORS)
        self.unanswered = not found.statuses and not found.unread
        found.log()
        self._warn_of_large_fleet(found.statuses)
        yield from metrics(found.statuses, found.unread)
        yield self._certificates.metric(newest_of_each_run(found.statuses))

    def _warn_of_large_fleet(self, statuses: list[RunStatus]) -> None:
        """Warn once if not all actors have series of their own."""
        for status in statuses:
            if status.fleet_size > len(status.actors) and not self._warned:
                self._warned = True
                _logger.warning(
                    "run %r has %d actors: %d of them have metrics of their own; those of the run are over all",
                    status.run,
                    status.fleet_size,
                    len(status.actors),
                )

    def describe(self) -> list[Metric]:
        """Return nothing, so that the registry does not query the learners to find the metrics."""
        return []


def serve_metrics(
    listener: tuple[str, int], endpoints: list[str], credentials: Credentials | None, stop: threading.Event
) -> int:
    """Serve the status of the learners at a host and port until `stop` is set, and return the exit status."""
    host, port = listener
    certificates = CertificateDays(endpoints, credentials)
    collector, registry = StatusCollector(certificates, run_for(credentials, keys.ANY_RUN)), CollectorRegistry()
    registry.register(collector)
    try:
        server = MetricsServer(host, port, registry)
    except OSError as error:
        print_error("exporter", f"cannot listen on {host}:{port}: {error.strerror}: choose another --listen")
        return FAILED
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    threading.Thread(target=certificates.follow, args=(stop,), name="certificates", daemon=True).start()
    _logger.info("serving http://%s:%d/metrics", host, server.server_port)
    try:
        _follow(collector, endpoints, credentials, stop)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
    return 0


def _follow(
    collector: StatusCollector, endpoints: list[str], credentials: Credentials | None, stop: threading.Event
) -> None:
    """Keep the collector connected until a signal."""

    def check() -> None:
        if stop.is_set():
            raise TransportError("stopped")

    retries = Retries(stop)
    while True:
        try:
            transport = connect_with_retry(endpoints, stop, credentials=credentials)
        except TransportError as error:  # a certificate is refused, perhaps until somebody renews one
            if retries.wait(str(error)):
                return
            continue
        if transport is None:
            return
        break
    collector.transport = transport
    try:
        while not stop.wait(_REOPEN_SECONDS):
            if collector.unanswered:
                # Zenoh reconnects by itself, except if the connection died without an error.
                with contextlib.suppress(TransportError):
                    SlowCall(transport.reopen).wait(check)
    finally:
        collector.transport = None
        transport.close()
