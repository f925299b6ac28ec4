"""The actor's service: join a learner, collect rollouts and upload them, follow its snapshots, leave.

The only threads are the caller's, which `run` occupies, and the transport's.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from daedalus.actor.collecting.collector import Collector
from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.errors import ActorError, LearnerLostError
from daedalus.actor.session.actor_config import ActorConfig, own_origin
from daedalus.actor.session.conversation import LearnerPresence, LearnerQueries, RunEndWatch, RunOverError
from daedalus.actor.session.session_engine import RuntimeMaker, SessionMonitor, SnapshotSource
from daedalus.actor.session.session_thread import StateLock
from daedalus.actor.session.snapshots import SnapshotFeed
from daedalus.actor.session.uploading import (
    ClientReports,
    RolloutUploadMaker,
    UploadMaker,
    UploadSession,
    make_upload_maker,
)
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import ClientReport, Join, Snapshot, Welcome
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_CONFIRMATIONS = 4  # requests for a newer snapshot within the largest age of the policy
_REFRESH_SECONDS = 0.2  # while a client fills a rollout: how often newer weights are looked for
_MANY_REJECTIONS = 20  # warn after this many consecutive rejections
_SLOW_LINK_WINDOW = 4  # most rollouts in flight on a slow link, unless the run asks for more


class ActorService:
    """One actor over one transport."""

    def __init__(
        self,
        config: ActorConfig,
        transport: Transport,
        stop: threading.Event,
        collector: Collector | None = None,
        on_join: Callable[[Welcome], object] = lambda _: None,
        report: Callable[[], ClientReport] | None = None,
    ) -> None:
        """Construct the service.

        Args:
          config: settings of this actor.
          transport: the network; the caller closes it.
          stop: event that ends `run`.
          collector: replaces the environments that the actor would create.
          on_join: called with the answer of each learner that the actor begins to join.
          report: returns what a client counts about itself; None: this actor is no client.
        """
        self._config, self._transport, self._stop = config, transport, stop
        self._collector = collector or EnvironmentCollector(config.environments, config.modules)
        self._join = Join(actor=config.name, incarnation=config.incarnation, origin=own_origin(transport))
        self._on_join = on_join
        self._lock = StateLock()
        self._queries = LearnerQueries(transport)
        self._presence = LearnerPresence(self._lock)
        self._upload_session = UploadSession(transport, config.name, self._presence, self._lock)
        self._end = RunEndWatch(transport, stop, self._lock.announce_change)
        self._monitor = SessionMonitor(
            self._upload_session, self._presence, self._queries, self._join, self._lock, self._end, self._on_poll
        )
        self._feed = SnapshotFeed(transport, self._queries, self._end, config.name, self._presence.heard)
        self._snapshots = SnapshotSource(self._feed, self._monitor, self._upload_session)
        self._runtimes = RuntimeMaker(config, self._queries, self._feed, self._monitor, self._end, stop)
        self._reports = None if report is None else ClientReports(transport, report)
        self._upload_maker: UploadMaker = RolloutUploadMaker()  # what is uploaded of the rollouts
        self._runs: set[str] = set()  # in which this actor's presence is declared
        self._learner_epoch = -1
        self._sequence = 0  # of the next rollout in this learner epoch
        self._loaded_version = -1  # the policy version that the collector uses
        self._warned_of_rejections = False

    def run(self) -> bool:
        """Collect until `stop` or until the learner says that the run is over; return whether the run finished.

        Raises ActorError if the actor is refused or quarantined, or finds no learner within its timeout;
        EnvironmentSetupError if the environment cannot be created here; PolicyError if the policy does not run.
        """
        try:
            while True:
                try:
                    self._join_run(self._find_learner())
                except LearnerLostError as error:
                    _logger.info("%s", error)
        except RunOverError as error:
            _logger.info("%s", error)
            return error.finished
        except Exception as error:
            self._queries.report_failure(self._end.run, self._join, error)
            raise
        finally:
            self._collector.close()

    def wake(self) -> None:
        """End a wait for a rollout of the collector. From any thread."""
        self._lock.announce_change()

    # ---------------------------------------------------------------------------------------------- joining

    def _find_learner(self) -> Welcome:
        run = self._config.run_to_join(self._end.run)
        welcome = self._queries.join_learner(run, self._join, self._timeout, self._end)
        self._presence.joined()
        return welcome

    @property
    def _timeout(self) -> float | None:
        """Seconds to look for a learner."""
        has_joined = self._learner_epoch >= 0
        return None if has_joined and self._config.waits_for_return else self._config.timeout

    def _join_run(self, welcome: Welcome) -> None:
        """Prepare the environments, join with their spaces, then collect until the learner or the run ends."""
        self._end.follow(welcome.run, welcome.learner_epoch)
        self._loaded_version = -1
        self._on_join(welcome)
        spaces, count = self._collector.prepare(welcome.spec)
        self._feed.begin(welcome)
        self._declare_presence(welcome.run)
        if self._reports is not None:
            self._reports.begin()
        join = replace(self._join, spaces=spaces, environments=count)
        confirmed = self._queries.join_learner(welcome.run, join, self._timeout, self._end)
        if confirmed.learner_epoch != welcome.learner_epoch:
            raise LearnerLostError
        if welcome.learner_epoch == self._learner_epoch:  # the network failed, not the learner
            self._upload_session.resume()
        else:
            self._upload_session.begin(welcome.run, welcome.spec.collection.window)
            self._learner_epoch, self._sequence = welcome.learner_epoch, 0
        if self._config.link == "wan" and not welcome.spec.algorithm.synchronous:
            self._feed.use_compact_snapshots()
        _logger.info("joined run %r as %r: %d x %s", welcome.run, self._config.name, count, welcome.spec.environment.id)
        runtime = self._runtimes.make(confirmed, spaces, count)
        self._collector.begin(runtime, confirmed.spec, confirmed.entropy(self._config.name), confirmed.epsilon)
        self._upload_maker = make_upload_maker(confirmed.spec, spaces, self._config.modules)
        if confirmed.spec.algorithm.synchronous:
            self._feed.subscribe()
        self._collect_and_upload(confirmed)

    def _declare_presence(self, run: str) -> None:
        if run in self._runs:
            return
        self._runs.add(run)
        self._transport.watch_presence(keys.learner(run), self._presence.on_presence)
        self._transport.declare_presence(keys.presence(run, self._config.name, self._config.incarnation))

    # ------------------------------------------------------------------------------------------- collecting

    def _collect_and_upload(self, welcome: Welcome) -> None:
        """Collect and upload until something raises: the session's end, or an error."""
        synchronous, window = welcome.spec.algorithm.synchronous, welcome.spec.collection.window
        snapshot = self._snapshots.await_newer(-1)
        if not synchronous:
            self._feed.use_fetches()
        while True:
            waited = self._wait_for_room()  # before collecting, so that the rollout is of the newest policy
            self._warn_of_rejections()
            self._load(snapshot if synchronous else self._snapshots.newest(waited))
            began = time.monotonic()
            payload = encode(self._upload_maker.compute(self._collect(welcome.learner_epoch)))
            if self._config.link == "auto" and self._snapshots.rollouts_are_slow:
                self._feed.use_differences()
            if self._feed.is_slow:
                self._upload_session.size_window(time.monotonic() - began, window, max(window, _SLOW_LINK_WINDOW))
            _check_size(payload, welcome.spec)
            self._upload_session.send(self._sequence, payload)
            self._sequence += 1
            if synchronous:
                snapshot = self._snapshots.await_newer(self._loaded_version)

    def _wait_for_room(self) -> float:
        """Wait until one more rollout may be sent; return the seconds that it took."""
        began = time.monotonic()
        self._monitor.wait_for_room()
        return time.monotonic() - began

    def _load(self, snapshot: Snapshot) -> None:
        if snapshot.policy_version != self._loaded_version:
            self._collector.load(snapshot)
            self._upload_maker.load(snapshot.weights)
            self._loaded_version = snapshot.policy_version
        self._collector.confirm(self._feed.confirmed_at)

    def _on_poll(self) -> None:
        """Report, and keep the policy from growing too old, in every wait: its learner may be busy for long."""
        if self._reports is not None:
            self._reports.send_if_due(self._end.run)
        if self._config.max_policy_age is None or self._loaded_version < 0 or self._feed.newest is None:
            return
        self._feed.read()
        self._load(self._feed.newest)
        if time.monotonic() > self._feed.confirmed_at + self._config.max_policy_age / _CONFIRMATIONS:
            self._feed.request_confirmation()

    def _collect(self, learner_epoch: int) -> Rollout:
        """Return the next rollout; while a client fills it, load newer weights as they come."""
        identity = RolloutIdentity(
            actor=self._config.name,
            incarnation=self._config.incarnation,
            sequence=self._sequence,
            learner_epoch=learner_epoch,
        )
        self._snapshots.begin_rollout()
        while (rollout := self._collector.collect(identity, self._on_row)) is None:
            if not self._monitor.wait(self._collector.has_rollout, _REFRESH_SECONDS):
                self._snapshots.fetch_if_due()
                self._load(self._snapshots.newest_that_came())
        self._snapshots.end_rollout()
        return rollout

    def _on_row(self) -> None:
        self._monitor.check_over()
        self._snapshots.fetch_if_due()

    def _warn_of_rejections(self) -> None:
        """Warn once that the learner rejects every rollout; it quarantines senders of unfit rollouts much earlier."""
        count, reason = self._upload_session.rejections
        if count >= _MANY_REJECTIONS and not self._warned_of_rejections:
            self._warned_of_rejections = True
            _logger.warning(
                "the learner rejected the last %d rollouts (%s): the link is too slow; raise training.max_policy_lag "
                "or move the actor closer to the learner",
                _MANY_REJECTIONS,
                reason,
            )


def _check_size(payload: bytes, spec: ActorSpec) -> None:
    """Raise ActorError if the learner does not receive messages of this size: they would be lost in silence."""
    if len(payload) > spec.max_upload_bytes:
        raise ActorError(
            f"a rollout of this actor has {len(payload) / 2**20:.1f} MiB, and the learner takes at most "
            f"{spec.max_upload_bytes / 2**20:g} MiB: set fewer environments (collection.envs_per_actor, "
            "or --envs of daedalus actor) or shorter rollouts (collection.rollout_length), or raise "
            "service.queue_megabytes of the run"
        )
