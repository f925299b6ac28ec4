"""Rollouts from environments that the actor creates and steps itself. No network, no threads."""

import logging
from collections.abc import Callable
from functools import partial

import numpy as np

from daedalus.actor.collecting.episode_lessons import LessonDraws, try_extremes
from daedalus.actor.collecting.lineup import Lineup, rating_copies
from daedalus.actor.collecting.rollout_writer import RolloutWriter, SeatWriter
from daedalus.actor.environments.bots import make_bot
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.games import GameEnvironments, make_games
from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.transforms import TransformedEnvironment
from daedalus.actor.environments.vector_environments import Observed, VectorEnvironment
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.policy.user_modules import NO_MODULES, UserModuleError, UserModules
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_SEEDS = 2**31  # every seed of an environment is below it: many environments pass theirs to a C int

_logger = logging.getLogger(__name__)


class EnvironmentCollector:
    """A Collector that creates environments as the run specifies and steps them.

    A rollout's arrays are views of the collector's: encode or copy the rollout before the next `collect`.

    Attributes:
      lineup: who plays the seats of games; None for environments with one agent.
    """

    def __init__(self, count: int | None = None, modules: UserModules = NO_MODULES) -> None:
        """Create no environments yet.

        Args:
          count: E, the number of environments, or of copies of a game; None: as many as the run specifies.
          modules: the modules that may be imported for environments and opponents.
        """
        self._count, self._modules = count, modules
        self._environments: VectorEnvironment | None = None
        self.lineup: Lineup | None = None
        self._requested: object = None  # what the environments were made for: a backend may make fewer of them
        self._runtime: PolicyRuntime | None = None
        self._writer: RolloutWriter | None = None
        self._draws: LessonDraws | None = None  # in a run with lessons
        self._reset: Callable[[], Observed] | None = None  # begins the first episodes, once there is a snapshot
        self._policy_version = -1

    def prepare(self, spec: ActorSpec) -> tuple[Spaces, int]:
        """See Collector. Reuse the environments of an earlier run with the same specification and number of them.

        Of games the number is that of the columns of a rollout.
        """
        count = self._count or spec.collection.envs_per_actor
        requested = (spec.environment, spec.league, spec.lessons, count)
        if self._requested != requested:
            self.close()
        if self._environments is None:
            if spec.environment.is_game:
                self._make_games(spec, count)
            else:
                self._environments = make_environments(spec.environment, count, modules=self._modules)
                if spec.lessons:
                    made = self._environments
                    try_extremes(spec, made.count, made.set_parameters, partial(made.reset, 0))
            self._requested = requested
        environments = self._environments
        assert environments is not None
        return environments.spaces, environments.count if self.lineup is None else self.lineup.columns

    def _make_games(self, spec: ActorSpec, count: int) -> None:
        try:
            self._modules.check({**spec.environment.user_modules, **spec.league.user_modules})
        except UserModuleError as error:
            raise EnvironmentSetupError(str(error)) from None
        games = self._games(spec, count)
        games.openings = spec.league.openings
        try:
            self.lineup = Lineup(
                spec.league,
                games,
                count,
                lambda name: make_bot(name, games.action_space, self._modules),
                spec.evaluation.max_episode_env_steps,
            )
            self._environments = TransformedEnvironment(games, spec.environment)
        except EnvironmentSetupError:
            games.close()
            raise
        if line := self.lineup.describe():
            _logger.info("%s", line)

    def _games(self, spec: ActorSpec, count: int) -> GameEnvironments:
        return make_games(spec.environment, count, self._modules, partial(rating_copies, spec.league, count))

    def begin(self, runtime: PolicyRuntime, spec: ActorSpec, seed: int, epsilon: float = 0.0) -> None:
        """See Collector. With lessons, the environments are reset when the first snapshot is loaded, which has them."""
        environments = self._environments
        assert environments is not None
        environment_seed, *action_seed = np.random.SeedSequence(seed).generate_state(4).tolist()  # of 32 bits each
        self._runtime = runtime
        if self.lineup is not None:
            make_writer = partial(SeatWriter, environments.spaces, self.lineup, environments.seats)
            self.lineup.begin(np.random.default_rng([*action_seed, 1]))
        else:
            make_writer = partial(RolloutWriter, environments.spaces, environments.count)
        self._writer = make_writer(
            runtime,
            spec.environment,
            rollout_length=spec.collection.rollout_length,
            random=np.random.default_rng(action_seed),
            epsilon=epsilon,
        )
        self._draws = LessonDraws(spec, np.random.default_rng([*action_seed, 2])) if spec.lessons else None
        reset = partial(environments.reset, environment_seed % (_SEEDS - environments.count))
        if self._draws is None:
            self._writer.start(reset())
        else:
            self._reset = reset  # until the first snapshot has the lessons

    def load(self, snapshot: Snapshot) -> None:
        """See Collector."""
        assert self._runtime is not None
        assert self._writer is not None
        self._runtime.load(snapshot.weights)
        self._policy_version = snapshot.policy_version
        if self._draws is not None and snapshot.lessons is not None:
            self._draws.plan = snapshot.lessons
        if self._reset is not None:
            self._begin_episodes(np.ones_like(self._writer.resets))
            self._writer.start(self._reset())
            self._reset = None

    def _begin_episodes(self, due: np.ndarray) -> None:
        """Draw the parameters of the episodes, [E] bool, that the next reset or step begins."""
        if self._draws is None or not np.count_nonzero(due):
            return
        assert self._writer is not None
        assert self._environments is not None
        drawn: dict[int, Parameters] = {index: self._draws.draw() for index in np.flatnonzero(due).tolist()}
        for index, parameters in drawn.items():
            self._writer.play(index, self._draws.with_lessons(parameters))
        self._environments.set_parameters(drawn)

    def confirm(self, at: float) -> None:
        """See Collector. Has no effect: the policy acts whatever its age."""

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout:
        """See Collector. Step the environments until the rollout is full."""
        writer, environments = self._writer, self._environments
        assert writer is not None
        assert environments is not None
        is_full = False
        while not is_full:
            on_row()
            self._begin_episodes(writer.resets)
            observed, rewards, terminated, truncated = environments.step(writer.act())
            is_full = writer.record(observed, rewards, terminated, truncated)
        return writer.finish(identity, self._policy_version, environments.take_episode_info())

    def close(self) -> None:
        """See Collector. Close the environments."""
        if self._environments is not None:
            self._environments.close()
        self._environments = self._requested = self._runtime = self._writer = self.lineup = None
        self._draws = self._reset = None
