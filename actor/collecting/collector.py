"""What an actor's service has play for it: environments of its own, or a loop that is somebody else's (client.py)."""

from collections.abc import Callable
from typing import Protocol

from daedalus.actor.collecting.environment_collector import Collector
from daedalus.actor.environments.interface import VectorEnvironment
from daedalus.actor.environments.make import make_environments
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.messages import Rollout, RolloutIdentity, Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

Wait = Callable[[Callable[[], bool], float], bool]  # until something holds, so many seconds at most; whether it does


class Player(Protocol):
    """Plays for one learner after the other. Its methods are for the service's thread."""

    def prepare(self, spec: RunSpec) -> tuple[Spaces, int]:
        """Makes ready for a run; what is shown and can be told, and E. Raises EnvironmentSetupError."""
        ...

    def begin(self, runtime: PolicyRuntime, spec: RunSpec, seed: int) -> None:
        """Plays with a policy from now on, whose weights come by `load`."""
        ...

    def load(self, snapshot: Snapshot) -> None:
        """Plays with these weights from the next rollout on."""
        ...

    def collect(self, identity: RolloutIdentity, wait: Wait, newest: Callable[[], Snapshot]) -> Rollout:
        """The next rollout. Who has to wait for it does so by `wait`, and may ask for the `newest` weights then.

        Its arrays are good until the next call.
        """
        ...

    def close(self) -> None:
        """Ends what it made."""
        ...


class EnvironmentPlayer:
    """Steps environments that it makes as the run says."""

    def __init__(self, environments: int | None = None, wrap: str | None = None) -> None:
        """`environments`: how many, if not as many as the run says; `wrap`: see make_environments."""
        self._count, self._wrap = environments, wrap
        self._made: tuple[EnvironmentSpec, VectorEnvironment] | None = None
        self._collector: Collector | None = None
        self._version = -1

    def prepare(self, spec: RunSpec) -> tuple[Spaces, int]:
        """See Player. Environments of an earlier run are played on if they are the same."""
        if self._made is not None and self._made[0] != spec.environment:
            self.close()
        if self._made is None:
            count = self._count or spec.collection.envs_per_actor
            self._made = spec.environment, make_environments(spec.environment, count, wrap=self._wrap)
        return self._made[1].spaces, self._made[1].count

    def begin(self, runtime: PolicyRuntime, spec: RunSpec, seed: int) -> None:
        """See Player."""
        assert self._made is not None
        length = spec.collection.rollout_length
        self._collector = Collector(self._made[1], runtime, spec.environment, rollout_length=length, seed=seed)

    def load(self, snapshot: Snapshot) -> None:
        """See Player."""
        assert self._collector is not None
        self._collector.load(snapshot.weights)
        self._version = snapshot.policy_version

    def collect(self, identity: RolloutIdentity, wait: Wait, newest: Callable[[], Snapshot]) -> Rollout:
        """See Player."""
        assert self._collector is not None
        return self._collector.collect(identity, self._version)

    def close(self) -> None:
        """See Player."""
        if self._made is not None:
            self._made[1].close()
        self._made = self._collector = None
