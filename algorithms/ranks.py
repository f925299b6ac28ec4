"""Ranks: the processes of one learner. Each has some environments of a batch and computes the gradient of their rows.

A number over the whole batch, such as the mean of its advantages, is a sum over the ranks.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Ranks(Protocol):
    """What the ranks compute together. All of them make the same calls in the same order."""

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of the ranks' values, which is the same on all ranks to the bit. May change `values`."""
        ...

    def permutation(self, number: int) -> Tensor:
        """Return the numbers from 0 to `number` - 1 in a random order, which is the same on all ranks."""
        ...


class _OneRank:
    """See Ranks."""

    def sum(self, values: Tensor) -> Tensor:
        return values

    def permutation(self, number: int) -> Tensor:
        return torch.randperm(number)


ONE_RANK: Ranks = _OneRank()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RankPart:
    """Which part of a whole batch a rank has. Its environments are columns first to end of the whole batch."""

    ranks: Ranks
    first: int
    end: int  # equal to `first` for a rank without environments: its batch is one column without valid rows
    valid: Tensor  # [T, B] float32, of the whole batch
    updates: int  # that the whole batch makes

    def all_have(self, value: object | None) -> bool:
        """Return whether no rank has None. All of them call it."""
        return not self.ranks.sum(self.valid.new_full((1,), float(value is None))).any()
