"""How often each choice of each discrete component of the actions was made. State; no I/O."""

import itertools

import torch

from daedalus.algorithms.batch import Batch
from daedalus.protocol.spaces import DiscreteSpace, Spaces


class ActionCounts:
    """Counts over batches, on a device."""

    def __init__(self, spaces: Spaces, device: torch.device) -> None:
        discrete = {name: space for name, space in spaces.actions.items() if isinstance(space, DiscreteSpace)}
        self._counts = {
            name: torch.zeros(space.choices, dtype=torch.int64, device=device) for name, space in discrete.items()
        }
        self._first_choices = {  # of each variable among all choices of its component
            name: torch.tensor([0, *itertools.accumulate(space.counts[:-1])], device=device)
            for name, space in discrete.items()
        }

    def add(self, batch: Batch) -> None:
        """Count the actions of the valid rows of a batch."""
        for name, counts in self._counts.items():
            choices = batch.actions[name].to(counts.device) + self._first_choices[name]  # [T, B, D]
            weights = batch.valid.to(counts.device).unsqueeze(-1).expand(choices.shape)
            counts += torch.bincount(choices.flatten(), weights.flatten(), len(counts)).to(torch.int64)

    def merge(self, counts: dict[str, torch.Tensor]) -> None:
        """Add counts by component, [choices] int64."""
        for name, own in self._counts.items():
            own += counts[name].to(own.device)

    def take(self) -> dict[str, list[int]]:
        """Return the counts by component since the last call."""
        taken = {name: counts.tolist() for name, counts in self._counts.items()}
        for counts in self._counts.values():
            counts.zero_()
        return taken
