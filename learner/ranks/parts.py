"""Parts of a batch, one for each rank. Pure functions."""

from dataclasses import replace

from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.ranks import RankPart, Ranks


def bounds_of(width: int, ranks: int) -> list[tuple[int, int]]:
    """Return the first environment and the end of each rank's part of `width` environments, as equal as possible."""
    each, more = divmod(width, ranks)
    ends = [(rank + 1) * each + min(rank + 1, more) for rank in range(ranks)]
    return list(zip([0, *ends[:-1]], ends, strict=True))


def part_of(batch: Batch, ranks: Ranks, first: int, end: int, updates: int) -> Batch:
    """Return environments `first` to `end` of a whole batch, in memory of their own.

    Without any environment it is a column without valid rows, from which nothing is learned: networks need not support
    empty batches.

    Args:
      batch: the whole batch.
      ranks: the processes that have the other parts.
      first, end: environments of the part.
      updates: number that the whole batch makes.
    """
    columns = slice(first, end) if end > first else slice(0, 1)

    def own(values: Tensor) -> Tensor:
        return values[:, columns].contiguous()

    part = replace(batch.map(own), initial_state=batch.initial_state[columns].contiguous())
    if end == first:
        part = replace(part, valid=part.valid.new_zeros(part.valid.shape))  # not in place: it may be the whole's memory
    return replace(part, rank_part=RankPart(ranks=ranks, first=first, end=end, valid=batch.valid, updates=updates))
