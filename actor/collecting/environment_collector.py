"""Rollouts from environments that the actor creates and steps itself. No network, no threads."""

from collections.abc import Callable
from functools import partial

import numpy as np

from daedalus.actor.collecting.rollout_writer import RolloutWriter, SeatWriter
from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.vector_environments import VectorEnvironment
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec, EnvironmentSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_SEEDS = 2**31  # every seed of an environment is below it: many environments pass theirs to a C int


class EnvironmentCollector:
    """A Collector that creates environments as the run specifies and steps them.

    A rollout's arrays are views of the collector's: encode or copy the rollout before the next `collect`.
    """

    def __init__(self, count: int | None = None, modules: UserModules = NO_MODULES) -> None:
        """Create no environments yet.

        Args:
          count: E, the number of environments; None: as many as the run specifies.
          modules: the modules that may be imported for environments.
        """
        self._count, self._modules = count, modules
        self._environments: VectorEnvironment | None = None
        self._requested: tuple[EnvironmentSpec, int] | None = None  # a backend may make fewer than this number
        self._runtime: PolicyRuntime | None = None
        self._writer: RolloutWriter | None = None
        self._policy_version = -1

    def prepare(self, spec: ActorSpec) -> tuple[Spaces, int]:
        """See Collector. Reuse the environments of an earlier run with the same specification and number of them."""
        count = self._count or spec.collection.envs_per_actor
        requested = (spec.environment, count)
        if self._requested != requested:
            self.close()
        if self._environments is None:
            self._environments = self._make(spec)
            self._requested = requested
        return self._environments.spaces, self._environments.count

    def _make(self, spec: ActorSpec) -> VectorEnvironment:
        """Return new environments for a run."""
        count = self._count or spec.collection.envs_per_actor
        return make_environments(spec.environment, count, modules=self._modules)

    def begin(self, runtime: PolicyRuntime, spec: ActorSpec, seed: int, epsilon: float = 0.0) -> None:
        """See Collector. Reset the environments."""
        environments = self._environments
        assert environments is not None
        environment_seed, *action_seed = np.random.SeedSequence(seed).generate_state(4).tolist()  # of 32 bits each
        self._runtime = runtime
        writer = partial(SeatWriter, seats=environments.seats) if spec.environment.is_game else RolloutWriter
        self._writer = writer(
            environments.spaces,
            environments.count,
            runtime,
            spec.environment,
            rollout_length=spec.collection.rollout_length,
            random=np.random.default_rng(action_seed),
            epsilon=epsilon,
        )
        self._writer.start(environments.reset(environment_seed % (_SEEDS - environments.count)))

    def load(self, snapshot: Snapshot) -> None:
        """See Collector."""
        assert self._runtime is not None
        self._runtime.load(snapshot.weights)
        self._policy_version = snapshot.policy_version

    def confirm(self, at: float) -> None:
        """See Collector. Has no effect: the policy acts whatever its age."""

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout:
        """See Collector. Step the environments until the rollout is full."""
        writer, environments = self._writer, self._environments
        assert writer is not None
        assert environments is not None
        on_row()
        while not writer.record(*environments.step(writer.act())):
            on_row()
        return writer.finish(identity, self._policy_version, environments.take_episode_info())

    def close(self) -> None:
        """See Collector. Close the environments."""
        if self._environments is not None:
            self._environments.close()
        self._environments = self._requested = self._runtime = self._writer = None
