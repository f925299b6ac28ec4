"""Algorithms by name. The record of the same name in daedalus/protocol/algorithms.py describes the scheduling."""

from collections.abc import Callable

from daedalus.algorithms.a2c import A2c
from daedalus.algorithms.a3c import A3c
from daedalus.algorithms.algorithm import Algorithm
from daedalus.algorithms.appo import Appo
from daedalus.algorithms.impala import Impala
from daedalus.policy.network.distributions.joint import ActionDistribution
from daedalus.protocol.spec import TrainingSpec

Builder = Callable[[TrainingSpec, ActionDistribution], Algorithm]
BUILDERS: dict[str, Builder] = {"a2c": A2c, "a3c": A3c, "impala": Impala, "appo": Appo}


def build_algorithm(spec: TrainingSpec, distribution: ActionDistribution) -> Algorithm:
    """Return the algorithm named by `spec.algorithm`, for a policy with these action distributions."""
    return BUILDERS[spec.algorithm](spec, distribution)
