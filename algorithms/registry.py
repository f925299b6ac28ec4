"""Algorithms by name: those of this package, and the user's own as `module:Class`."""

from daedalus.algorithms.a2c import A2c
from daedalus.algorithms.a3c import A3c
from daedalus.algorithms.algorithm import Algorithm
from daedalus.algorithms.appo import Appo
from daedalus.algorithms.impala import Impala
from daedalus.algorithms.n_step_q import NStepQ
from daedalus.algorithms.one_step_q import OneStepQ
from daedalus.algorithms.one_step_sarsa import OneStepSarsa
from daedalus.algorithms.own_algorithm import own_algorithm
from daedalus.policy.network.action_distribution import ActionDistribution
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.algorithms import is_own
from daedalus.protocol.spec import LossSpec

CLASSES: dict[str, type[Algorithm]] = {
    "a2c": A2c,
    "a3c": A3c,
    "impala": Impala,
    "appo": Appo,
    "one_step_q": OneStepQ,
    "one_step_sarsa": OneStepSarsa,
    "n_step_q": NStepQ,
}


def build_algorithm(spec: LossSpec, distribution: ActionDistribution, modules: UserModules = NO_MODULES) -> Algorithm:
    """Return the algorithm named by `spec.algorithm`, for a policy with these action distributions.

    `modules` may be imported. Raises AlgorithmError for an algorithm of the user's own that cannot be constructed.
    """
    if is_own(spec.algorithm):
        return own_algorithm(spec, distribution, modules)
    return CLASSES[spec.algorithm](spec, distribution)
