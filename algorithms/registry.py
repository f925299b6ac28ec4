"""Algorithms by name. The record of the same name in daedalus/protocol/algorithms.py describes the scheduling."""

from collections.abc import Callable

from daedalus.algorithms.a2c import A2c
from daedalus.algorithms.a3c import A3c
from daedalus.algorithms.algorithm import Algorithm
from daedalus.algorithms.appo import Appo
from daedalus.algorithms.impala import Impala
from daedalus.protocol.spec import TrainingSpec

BUILDERS: dict[str, Callable[[TrainingSpec], Algorithm]] = {"a2c": A2c, "a3c": A3c, "impala": Impala, "appo": Appo}


def build_algorithm(spec: TrainingSpec) -> Algorithm:
    """Return the algorithm named by `spec.algorithm`."""
    return BUILDERS[spec.algorithm](spec)
