"""The actor's service: the session engine on the caller's thread, with the environments and the policy.

The only threads are the caller's, which `run` occupies, and the transport's.
"""

import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.collecting.lineup import Lineup
from daedalus.actor.errors import ActorError
from daedalus.actor.session.actor_config import ActorConfig, own_origin
from daedalus.actor.session.conversation import RunOverError
from daedalus.actor.session.league_feed import Oppose
from daedalus.actor.session.session_engine import ActorSession, Begin, Collect, Encode, Load, Prepare
from daedalus.actor.session.session_thread import SessionThread
from daedalus.actor.session.uploading import RolloutUploadMaker, UploadMaker, make_upload_maker
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyError, PolicyRuntime
from daedalus.policy.acting.shared_runtime import SharedRuntime
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import ClientReport, Snapshot, Welcome
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec, LearningSpec, UnsupportedRunError
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.interface import Transport
from daedalus.transport.process_usage import UsageMeter


class Collector(Protocol):
    """A source of rollouts for one learner after the other. Its methods are for the service's thread."""

    @property
    def lineup(self) -> Lineup | None:
        """Who plays the seats of the games that it steps; None if it steps none, and before `prepare`."""
        ...

    def prepare(self, spec: ActorSpec) -> tuple[Spaces, int]:
        """Prepare for a run, and return its spaces and E, the number of environments.

        Raises EnvironmentSetupError or ActorError if this actor cannot take part in the run.
        """
        ...

    def begin(self, runtime: PolicyRuntime, spec: ActorSpec, seed: int, epsilon: float = 0.0) -> None:
        """Collect with a policy from now on; `load` provides its weights before the first rollout.

        `seed` is the `entropy` of the learner's Welcome, and `epsilon` is its own.
        """
        ...

    def load(self, snapshot: Snapshot) -> None:
        """Use these weights from the next rollout on."""
        ...

    def confirm(self, at: float) -> None:
        """Note that the loaded snapshot was the learner's newest at a monotonic time, in seconds."""
        ...

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None]) -> Rollout | None:
        """Return the next rollout, or None if it depends on somebody else and is not complete yet.

        The rollout's arrays are valid until the next call. While this method makes the rollout, it calls `on_row`
        before each row; what `on_row` raises ends the rollout.
        """
        ...

    def close(self) -> None:
        """Release everything that `prepare` created. Idempotent."""
        ...


_logger = logging.getLogger(__name__)


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
        self._config, self._stop, self._on_join = config, stop, on_join
        self._collector = collector or EnvironmentCollector(config.environments, config.modules)
        self._session = ActorSession(config, own_origin(transport), report)
        self._session.reports.usage = UsageMeter().measure
        self._thread = SessionThread(self._session, transport, stop)
        self._own_runtime: PolicyRuntime | None = None
        self._begin: Begin | None = None  # the newest
        self._upload_maker: UploadMaker = RolloutUploadMaker()  # what is uploaded of the rollouts

    def run(self) -> bool:
        """Collect until `stop` or until the learner says that the run is over; return whether the run finished.

        Raises ActorError if the actor is refused or quarantined, or finds no learner within its timeout;
        EnvironmentSetupError if the environment cannot be created here; PolicyError if the policy does not run.
        """
        try:
            return self._thread.run(self._session.play(), self._perform)  # until it raises
        except RunOverError as error:
            _logger.info("%s%s", f"run {self._session.run!r}: " if self._session.run else "", error)
            return error.finished
        except Exception as error:
            self._thread.run(self._session.report_failure(error), to_the_end=True)
            raise
        finally:
            self._collector.close()

    def wake(self) -> None:
        """End a wait for a rollout of the collector. From any thread."""
        self._thread.notify(self._note_rollout)

    def leave(self, by: float) -> None:
        """Finish and upload the present rollout, then end `run`; at the latest at a monotonic time. From any thread."""
        self._thread.notify(self._session.leave, by)

    def _note_rollout(self) -> None:
        self._session.rollout_ready = True

    def _perform(self, action: Any) -> Any:
        """Perform an action of the session, and return what came of it."""
        match action:
            case Collect(identity):
                return self._collector.collect(identity, self._on_row)
            case Encode(rollout):
                return encode(self._upload_maker.compute(rollout))
            case Load(snapshot, confirmed_at):
                if snapshot is not None:
                    self._collector.load(snapshot)
                    self._upload_maker.load(snapshot.weights)
                self._collector.confirm(confirmed_at)
            case Prepare(welcome):
                self._on_join(welcome)
                prepared = self._collector.prepare(welcome.spec)
                self._session.has_opponents = (
                    self._collector.lineup is not None and self._collector.lineup.has_opponents
                )
                return prepared
            case Oppose():
                return self._oppose(action)
            case Begin(welcome):
                self._own_runtime, self._begin = self._runtime(action), action
                self._collector.begin(
                    self._own_runtime, welcome.spec, welcome.entropy(self._config.name), welcome.epsilon
                )
                self._upload_maker = make_upload_maker(welcome.spec, action.spaces, self._config.modules)
        return None

    def on_wait(self) -> None:
        """Do what falls due while a rollout waits for somebody else. Raises what ends the rollout."""
        self._act_in_rollout(self._session.is_due(time.monotonic()))

    def _oppose(self, news: Oppose) -> str:
        """Take a plan or a policy for the games, and return which player's policy is wanted."""
        lineup = self._collector.lineup
        assert lineup is not None
        if news.plan is not None:
            lineup.plan = news.plan
        if news.snapshot is None:
            lineup.give_up(news.player)
            return lineup.wanted
        try:
            lineup.add_policy(news.player, self._opponent_runtime(news.snapshot, news.program))
        except PolicyError as error:  # of the opponent: the run's own policy plays on
            _logger.warning("opponent %s does not play: %s", news.player, error)
            lineup.give_up(news.player)
        return lineup.wanted

    def _opponent_runtime(self, snapshot: Snapshot, program: bytes | None) -> PolicyRuntime:
        assert self._begin is not None
        if program is not None:
            runtime: PolicyRuntime = OnnxRuntime(program, self._stop)
        elif isinstance(self._own_runtime, OnnxRuntime):
            runtime = self._own_runtime.fork()
        else:
            runtime = self._local_runtime(self._begin)
        runtime.load(snapshot.weights)
        return runtime

    def _on_row(self) -> None:
        self._act_in_rollout(self._session.begin_row(time.monotonic()))

    def _act_in_rollout(self, is_due: bool) -> None:
        if is_due:
            self._thread.call(self._session.act_in_rollout)
        else:
            self._thread.call_after_events(self._session.check_over)

    def _runtime(self, begin: Begin) -> PolicyRuntime:
        """Return the runtime of the policy."""
        if self._config.inference is None:
            return self._local_runtime(begin)
        setup: dict[str, Any] = {}
        if begin.program is None:
            learning = _learning_of(begin).model_dump(mode="json")
            setup = {"learning": learning, "spaces": begin.spaces.model_dump(mode="json")}
        return SharedRuntime(self._config.inference, setup, begin.program or b"", begin.spaces, self._stop)

    def _local_runtime(self, begin: Begin) -> PolicyRuntime:
        spec = begin.welcome.spec
        if begin.program is not None:
            rows = begin.environments * spec.collection.rollout_length  # a rollout is played with one snapshot
            return OnnxRuntime(begin.program, self._stop, rows)
        from daedalus.policy.acting.torch_runtime import TorchRuntime  # the only part of an actor with torch

        learning = _learning_of(begin)
        return TorchRuntime(learning.policy, begin.spaces, learning.training)


def _learning_of(begin: Begin) -> LearningSpec:
    try:
        return begin.welcome.spec.learning_settings
    except UnsupportedRunError as error:
        raise ActorError(str(error)) from None
