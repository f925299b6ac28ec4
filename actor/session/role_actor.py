"""One actor whose seats belong to several runs: the games are shared, and each run has its own session and thread."""

import logging
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.collecting.lineup import sides_of
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.games import GameEnvironments
from daedalus.actor.environments.shared_games import RoleEnvironments, SharedGames
from daedalus.actor.errors import ActorError
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.policy.saving.saved_policy import SavedPolicy, find_policy
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol import keys
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.1
_LEAVE_SECONDS = 30.0  # for the other runs' rollouts, after an operator has drained the actor in one run
_NO_LEARNER = RolloutIdentity(actor="-", incarnation=0, sequence=0, learner_epoch=0)  # of rows that nobody learns from


@dataclass(frozen=True, slots=True, kw_only=True)
class Seating:
    """Seats of an actor, and who plays them."""

    names: tuple[str, ...]  # roles or agents of the game
    run: str  # whose policy plays them
    policy: Path | None = None  # of a run directory, which has no learner any more; None: the run's learner has it

    @property
    def description(self) -> str:
        """The names, for a message."""
        return " and ".join(self.names)


class _AllOverError(Exception):
    """Nobody learns from the games any more."""


class RoleCollector(EnvironmentCollector):
    """A Collector of one run's seats in shared games. `close` leaves the games to the other runs.

    Attributes:
      on_wait: see RoleEnvironments.
    """

    def __init__(
        self, games: SharedGames, run: str, count: int | None = None, modules: UserModules = NO_MODULES
    ) -> None:
        """Join the games with the first `prepare`. `count` and `modules` are those of the games."""
        super().__init__(count, modules)
        self._shared, self._run = games, run
        self._seats: RoleEnvironments | None = None
        self._spec: ActorSpec | None = None
        self._beginning: Callable[[], None] | None = None  # waits for the other runs: left to the first `collect`
        self._has_begun = False
        self._epsilon = 0.0
        self._snapshot: Snapshot | None = None
        self.on_wait: Callable[[], object] = lambda: None

    @property
    def has_policy(self) -> bool:
        """Whether there is a policy that can play the seats."""
        return self._snapshot is not None

    def prepare(self, spec: ActorSpec) -> tuple[Spaces, int]:
        """See Collector."""
        if self._spec not in (None, spec):
            raise self._changed()
        prepared = super().prepare(spec)
        self._spec = spec
        return prepared

    def _changed(self) -> ActorError:
        return ActorError(f"the run {self._run!r} has other settings than before: start this actor again")

    def _games(self, spec: ActorSpec, count: int) -> GameEnvironments:
        self._seats = self._shared.join(self._run, spec)
        if len(sides_of(spec.league, self._seats.agents)) > 1:
            raise EnvironmentSetupError(
                f"the run {self._run!r} shares its games with other runs, so its own agents are one side: set "
                f"league.sides=[{list(self._seats.agents)}]"
            )
        return self._seats

    def begin(self, runtime: PolicyRuntime, spec: ActorSpec, seed: int, epsilon: float = 0.0) -> None:
        """See Collector. A learner that has returned finds the matches under way, with the memory of its seats."""
        if not self._has_begun:
            self._beginning = partial(super().begin, runtime, spec, seed, epsilon)
            self._epsilon = epsilon
            return
        before = self._runtime
        assert before is not None
        assert self._writer is not None
        fixed = before.state_size, before.noise_size, self._epsilon
        if fixed != (runtime.state_size, runtime.noise_size, epsilon):
            raise self._changed()
        self._runtime = runtime
        self._writer.use(runtime)

    def load(self, snapshot: Snapshot) -> None:
        """See Collector."""
        self._snapshot = snapshot
        if self._has_begun:
            super().load(snapshot)

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout:
        """See Collector. The first rollout waits until all runs have begun."""
        assert self._seats is not None
        self._seats.on_wait = self.on_wait
        if not self._has_begun:
            assert self._beginning is not None
            assert self._snapshot is not None
            self._beginning()
            self._has_begun = True
            super().load(self._snapshot)
        return super().collect(identity, on_row)

    def play_on(self, check: Callable[[], None]) -> None:
        """Play with the last policy until `check` raises; nothing is learned from it."""
        self.on_wait = check
        while True:
            self.collect(_NO_LEARNER, check)

    def close(self) -> None:
        """See Collector."""


class _Role:
    """The seats of one run, and the thread that plays them."""

    def __init__(self, seating: Seating, collector: RoleCollector, check: Callable[[], None]) -> None:
        """`check` raises when the seats need not be played any more."""
        self.seating, self.collector, self._check = seating, collector, check
        self.service: ActorService | None = None  # None: the policy does not learn any more
        self.finished = self.left = False  # the run; the actor, for another reason
        self.error: Exception | None = None
        self.thread = threading.Thread(target=self._run, name=f"role-{seating.run}", daemon=True)

    def _run(self) -> None:
        try:
            self._play()
        except _AllOverError:
            pass
        except Exception as error:  # the thread of the actor raises it again
            self.error = error

    def _play(self) -> None:
        if self.service is None:
            self._take_policy(find_policy(self.seating.policy or Path(), newest=True))
        else:
            self.finished = self.service.run()
            self.left = not self.finished
            self._check()
            if not self.collector.has_policy:
                raise ActorError(
                    f"the run {self.seating.run!r} is over, and this actor has no policy of it: name its run "
                    f"directory, as in --seat {self.seating.names[0]}=runs/{self.seating.run}"
                )
        _logger.info(
            "the policy of run %r plays %s until the other runs are over, and does not learn from it",
            self.seating.run,
            self.seating.description,
        )
        self.collector.play_on(self._check)

    def _take_policy(self, saved: SavedPolicy) -> None:
        spec = saved.spec.for_actors()
        spaces, _ = self.collector.prepare(spec)
        if spaces != saved.spaces:
            raise ActorError(
                f"the seats {self.seating.description} have {spaces}; {saved.directory} has {saved.spaces}"
            )
        self.collector.begin(OnnxRuntime(saved.program), spec, seed=secrets.randbits(64))
        self.collector.load(
            Snapshot(learner_epoch=0, policy_version=saved.policy_version, program="", weights=saved.weights)
        )


class RoleActor:
    """An actor in several runs at once. It ends when all of them are over."""

    def __init__(
        self,
        config: ActorConfig,
        seatings: Sequence[Seating],
        connect: Callable[[], Transport],
        stop: threading.Event,
    ) -> None:
        """Construct the sessions, and connect each of them.

        Args:
          config: settings of this actor. Its name in a run ends with that of the seats.
          seatings: the seats, of at least one run with a learner.
          connect: returns a connection of its own for each session; the caller closes it.
          stop: event that ends `run`.
        """
        self._stop, self._ends = stop, threading.Event()
        self._games = SharedGames({each.run: each.names for each in seatings}, config.environments, config.modules)
        self._roles: list[_Role] = []
        for each in seatings:
            collector = RoleCollector(self._games, each.run, config.environments, config.modules)
            role = _Role(each, collector, self._check)
            if each.policy is None:
                own = replace(config, name=keys.as_name(f"{config.name}.{'-'.join(each.names)}"), run=each.run)
                role.service = ActorService(own, connect(), self._ends, collector)
                collector.on_wait = role.service.on_wait
            self._roles.append(role)
        self._learning = [role for role in self._roles if role.service is not None]

    def run(self) -> bool:
        """Collect until `stop` or until all runs are over; return whether all finished. Raises as ActorService.run."""
        try:
            for role in self._roles:
                role.thread.start()
            left = False
            while any(role.thread.is_alive() for role in self._roles):
                stopped = self._stop.wait(_POLL_SECONDS)
                failed = any(role.error is not None for role in self._roles)
                if stopped or failed:
                    break
                if not left and any(role.left for role in self._roles):
                    left = True
                    self.leave(time.monotonic() + _LEAVE_SECONDS)
        finally:
            self._ends.set()
            for role in self._roles:
                if role.thread.ident is not None:
                    role.thread.join()
            errors = [role.error for role in self._roles if role.error is not None]
            with suppress(*([EnvironmentSetupError] if errors else [])):  # of games that failed already
                self._games.close()
        if errors:
            raise errors[0]
        return all(role.finished for role in self._learning)

    def leave(self, by: float) -> None:
        """Finish and upload the present rollouts, then end `run`; at the latest at a monotonic time."""
        for role in self._learning:
            if role.service is not None and not (role.finished or role.left):
                role.service.leave(by)

    def _check(self) -> None:
        if self._ends.is_set() or all(role.finished or role.left for role in self._learning):
            raise _AllOverError
