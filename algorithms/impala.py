"""IMPALA: asynchronous actor-critic, corrected for policy lag by V-trace."""

from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.algorithms.targets import vtrace_corrected_targets
from daedalus.policy.network.distributions.joint import ActionDistribution
from daedalus.protocol.spec import TrainingSpec


class Impala(PolicyGradient):
    """Actor-critic with V-trace targets: Espeholt et al. (2018), section 4."""

    def __init__(self, spec: TrainingSpec, distribution: ActionDistribution) -> None:
        super().__init__(spec, distribution, vtrace_corrected_targets)
