"""IMPALA: asynchronous actor-critic, corrected for policy lag by V-trace."""

from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.algorithms.returns import Targets
from daedalus.algorithms.targets import vtrace_corrected_targets
from daedalus.protocol.algorithms import ALGORITHMS


class Impala(PolicyGradient):
    """Actor-critic with V-trace targets: Espeholt et al. (2018), section 4."""

    record = ALGORITHMS["impala"]

    def targets(self, batch: Batch, log_probs: Tensor, values: Tensor) -> Targets:
        """See PolicyGradient."""
        return vtrace_corrected_targets(self.spec, batch, log_probs, values)
