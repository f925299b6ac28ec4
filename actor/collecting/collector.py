"""The interface between an actor's service and whatever produces its rollouts."""

from collections.abc import Callable
from typing import Protocol

from daedalus.actor.collecting.lineup import Lineup
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity


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
