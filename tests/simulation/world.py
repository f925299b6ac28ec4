"""The processes of one simulation, and a supervisor that restarts those that end."""

from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement
from daedalus.protocol.uploads import Rollout

from . import codec
from .actors import ActorProcess
from .kernel import Kernel
from .learners import Disk, LearnerProcess
from .ledger import Ledger
from .network import Network
from .settings import Settings
from .traffic import LinkRequest

_STOP_SECONDS = 7.0  # in which a process ends that is asked to stop: a query of 5 s may have no answer


class World:
    """All processes, their network, and the ledger of their rollouts."""

    def __init__(self, kernel: Kernel, settings: Settings) -> None:
        self.kernel, self.settings = kernel, settings
        self.network = Network(kernel, settings.weather)
        self.network.on_reply = self._on_reply
        self.ledger = Ledger(kernel, settings.spec)
        self.actors: dict[str, ActorProcess] = {}  # the newest incarnation of each
        self.learner: LearnerProcess
        self.longest_stop = 0.0
        self.supervised = True  # whether processes that end are started again
        self._disk = Disk()
        self._absences: dict[str, float] = {}  # by actor: seconds until it is started again
        self._incarnations = self._lives = 0
        self._running: dict[ActorProcess, None] = {}

    @property
    def running(self) -> list[ActorProcess]:
        """Actor processes that have not ended."""
        return list(self._running)

    def start(self) -> None:
        """Start the learner, and each actor within a second."""
        self.start_learner()
        for index in range(self.settings.spec.collection.actors):
            self.kernel.after(self.kernel.random.random(), self.start_actor, f"a{index}")

    # ----------------------------------------------------------------------------------------------- learner

    def start_learner(self) -> None:
        """Start a learner, unless the simulation ends. There must be none."""
        if not self.supervised:
            return
        self._lives += 1
        self.network.cut = False
        self.learner = LearnerProcess(
            self.kernel,
            self.network,
            self.ledger,
            self.settings,
            self._disk,
            epoch=1000 + self._lives,
            on_end=self._on_learner_end,
        )
        self.learner.start()

    def _on_learner_end(self) -> None:
        if self.settings.embedded:
            self.kernel.after(self.learner.link.seconds_to_send, self._lose_router)
        if self.supervised:
            self.kernel.after(self.kernel.random.choice((0.01, 0.3, 3.0)), self.start_learner)

    def _lose_router(self) -> None:
        if self.learner.done:
            self.network.cut = True

    def join_router(self) -> None:
        """Bring the router back, unless it is a learner that is gone."""
        self.network.cut = self.settings.embedded and self.learner.done

    # ------------------------------------------------------------------------------------------------ actors

    def start_actor(self, name: str) -> None:
        """Start an incarnation of an actor, unless the simulation ends."""
        if not self.supervised:
            return
        self._incarnations += 1
        actor = ActorProcess(
            self.kernel,
            self.network,
            self.ledger,
            name=name,
            incarnation=self._incarnations,
            settings=self.settings.actors[int(name[1:])],
            on_end=self._on_actor_end,
        )
        self.actors[name] = actor
        self._running[actor] = None
        actor.start()

    def keep_away(self, actor: ActorProcess, seconds: float) -> None:
        """Restart an actor that is about to end only after some time."""
        self._absences[actor.name] = seconds

    def stop_actor(self, actor: ActorProcess) -> None:
        """Ask an actor to stop, as SIGTERM does."""
        self.kernel.log("stop", actor.process.name)
        actor.stopping = True
        seconds = _STOP_SECONDS + self.settings.poll_seconds
        self.kernel.after(seconds, self._require_end, actor, seconds)
        self.kernel.after(0.0, self._time_stop, actor, self.kernel.now)

    def _time_stop(self, actor: ActorProcess, since: float) -> None:
        self.longest_stop = max(self.longest_stop, self.kernel.now - since)
        if not actor.outcome:
            self.kernel.after(0.1, self._time_stop, actor, since)

    def _require_end(self, actor: ActorProcess, seconds: float) -> None:
        if self.kernel.now < actor.hangs_until and not actor.outcome:
            self.kernel.after(actor.hangs_until - self.kernel.now + seconds, self._require_end, actor, seconds)
            return
        excused = actor.process.frozen or actor.is_disturbed
        ended = bool(actor.outcome) or excused
        self.ledger.require(ended, actor.process.name, f"did not end {seconds:g} s after its stop")

    def _on_actor_end(self, actor: ActorProcess) -> None:
        del self._running[actor]
        if self.supervised and self.actors[actor.name] is actor:
            pause = self._absences.pop(actor.name, self.kernel.random.uniform(0.1, 2.0))
            self.kernel.after(pause, self.start_actor, actor.name)

    # ----------------------------------------------------------------------------------------------- network

    def _on_reply(self, request: LinkRequest, payload: bytes) -> None:
        if "/rollouts/" not in request.key:
            return
        rollout, answer = codec.decode(request.payload, Limits()), codec.decode(payload, Limits())
        assert isinstance(rollout, Rollout)
        assert isinstance(answer, Acknowledgement)
        life = next(life for life in self.ledger.lives if request.server.process.name == f"learner{life.number}")
        self.ledger.answered(life, rollout.identity, answer)
