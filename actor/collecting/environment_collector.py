"""Plays a policy in environments and gathers rollouts. No network, no threads."""

import numpy as np

from daedalus.actor.collecting.rollout_writer import RolloutWriter
from daedalus.actor.environments.interface import VectorEnvironment
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.messages import Rollout, RolloutIdentity
from daedalus.protocol.spec import EnvironmentSpec


class Collector:
    """Steps E environments.

    A rollout's arrays are views of the collector's: encode it before the next `collect`.
    """

    def __init__(
        self,
        environments: VectorEnvironment,
        runtime: PolicyRuntime,
        spec: EnvironmentSpec,
        *,
        rollout_length: int,
        seed: int,
    ) -> None:
        environment_seed, action_seed = np.random.SeedSequence(seed).generate_state(2)
        self._environments = environments
        self._writer = RolloutWriter(
            environments.spaces,
            environments.count,
            runtime,
            spec,
            rollout_length=rollout_length,
            random=np.random.default_rng(action_seed),
        )
        self._writer.start(environments.reset(int(environment_seed)))

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Plays on with these weights from the next rollout."""
        self._writer.load(weights)

    def collect(self, identity: RolloutIdentity, policy_version: int) -> Rollout:
        """T rows more under the weights loaded last, whose version the caller names."""
        while not self._writer.record(*self._environments.step(self._writer.act())):
            pass
        return self._writer.finish(identity, policy_version)
