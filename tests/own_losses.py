"""An algorithm of a user's, with an argument."""

from typing import Any

from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.protocol.algorithms import AlgorithmRecord


class Weighted(PolicyGradient):
    """Takes a weight, and does nothing with it."""

    record = AlgorithmRecord(synchronous=True)

    def __init__(self, spec: Any, distribution: Any, *, weight: float = 1.0) -> None:
        super().__init__(spec, distribution)
        self.weight = weight
