"""What rank 0 does with the other ranks: it gives them their parts of each batch and collects what they measured.

A learner of one process has the null object NO_OTHER_RANKS in its place.
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.learner.ranks.agreement import Run, described
from daedalus.learner.ranks.commands import Command, CommandKind, give
from daedalus.learner.ranks.errors import RankLostError, RanksDisagreeError
from daedalus.learner.ranks.group import Group
from daedalus.learner.ranks.parts import bounds_of, part_of
from daedalus.protocol.spaces import Spaces

_logger = logging.getLogger(__name__)

_WAIT_SECONDS = 5.0  # between two commands to wait
_STATE_BATCHES = 100  # between two exchanges of the state, so that differently rounding processors stay together


class OtherRanks(Protocol):
    """The other processes that compute the updates of a learner."""

    def begin(self, spaces: Spaces, state: Callable[[], Sequence[Tensor]]) -> None:
        """Let the other processes construct their learners, with the state of this one's.

        Args:
          spaces: of the run.
          state: returns all tensors that updates depend on.

        Raises RanksDisagreeError if one of them cannot.
        """
        ...

    def part(self, batch: Batch, constants: Sequence[Tensor], version: int, end: int, progress: float) -> Batch:
        """Return the part of a batch that this process learns from, after the others have got theirs.

        Args:
          batch: the whole batch, in main memory.
          constants: parameters of the network that no gradient changes.
          version: policy version before the updates of the batch.
          end: policy version after them.
          progress: share of the budget that is used.
        """
        ...

    def collect(self, first_pass: FirstPass) -> FirstPass:
        """Return the first pass of the whole batch for that of this process's part."""
        ...

    def wait(self) -> None:
        """Tell the other processes that this one is alive. Call it often while there is no batch."""
        ...

    def close(self) -> None:
        """End the other processes, those that can be reached."""
        ...


class _NoOtherRanks:
    """See OtherRanks."""

    def begin(self, spaces: Spaces, state: Callable[[], Sequence[Tensor]]) -> None:
        pass

    def part(self, batch: Batch, constants: Sequence[Tensor], version: int, end: int, progress: float) -> Batch:
        return batch

    def collect(self, first_pass: FirstPass) -> FirstPass:
        return first_pass

    def wait(self) -> None:
        pass

    def close(self) -> None:
        pass


NO_OTHER_RANKS: OtherRanks = _NoOtherRanks()


class Leader:
    """Rank 0 of a learner of several processes. See OtherRanks; each method raises RankLostError if it loses one."""

    def __init__(self, group: Group, run: Run) -> None:
        """Check that all ranks were started for the same run. Raises RanksDisagreeError or RankLostError."""
        self._group = group
        self._batches = 0
        self._bounds: list[tuple[int, int]] = []  # of the newest batch
        self._state: Callable[[], Sequence[Tensor]] = tuple
        self._commanded_at = time.monotonic()
        group.announce(described(run))
        self._check_reports()

    def begin(self, spaces: Spaces, state: Callable[[], Sequence[Tensor]]) -> None:
        """See OtherRanks."""
        self._state = state
        self._command(Command(kind=CommandKind.BEGIN))
        self._group.announce(spaces.model_dump_json())
        self._check_reports()
        self._synchronize()
        _logger.info("%d processes compute the updates", self._group.number)

    def part(self, batch: Batch, constants: Sequence[Tensor], version: int, end: int, progress: float) -> Batch:
        """See OtherRanks."""
        self._batches += 1
        if self._batches % _STATE_BATCHES == 0:
            self._command(Command(kind=CommandKind.STATE))
            self._synchronize()
        rows, width = batch.rewards.shape
        self._bounds = bounds_of(width, self._group.number)
        self._command(
            Command(kind=CommandKind.BATCH, rows=rows, environments=width, version=version, end=end, progress=progress)
        )
        exchange(self._group, [*constants, batch.valid])
        own, *others = (part_of(batch, self._group, *bounds, end - version) for bounds in self._bounds)
        for rank, other in enumerate(others, 1):
            self._group.send(other.tensors(), rank)
        return own

    def collect(self, first_pass: FirstPass) -> FirstPass:
        """See OtherRanks."""
        stacked = _stacked(first_pass)
        parts = [stacked]
        for rank in self._group.others:
            first, end = self._bounds[rank]
            parts.append(torch.zeros((*stacked.shape[:2], end - first)))
            self._group.receive(parts[-1:], rank)
        *log_probs, behaviour, values, targets, advantages, valid = torch.cat(parts, dim=2).to(first_pass.values.device)
        return FirstPass(log_probs[0] if log_probs else None, behaviour, values, targets, advantages, valid)

    def wait(self) -> None:
        """See OtherRanks."""
        if time.monotonic() > self._commanded_at + _WAIT_SECONDS:
            self._command(Command(kind=CommandKind.WAIT))

    def close(self) -> None:
        """See OtherRanks."""
        try:
            self._command(Command(kind=CommandKind.END))
        except RankLostError:
            return

    def _command(self, command: Command) -> None:
        give(self._group, command)
        self._commanded_at = time.monotonic()

    def _synchronize(self) -> None:
        exchange(self._group, self._state())

    def _check_reports(self) -> None:
        for text in filter(None, self._group.report()):
            raise RanksDisagreeError(text)


def exchange(group: Group, tensors: Sequence[Tensor]) -> None:
    """Replace tensors in place by those of rank 0. Raises RankLostError."""
    with torch.no_grad():
        for tensor in tensors:
            tensor.copy_(group.first(tensor.detach()))


def report_first_pass(group: Group, first_pass: FirstPass, environments: int) -> None:
    """Send the first pass of a part, of so many environments, to rank 0. See Leader.collect."""
    group.send([_stacked(first_pass)[:, :, :environments].contiguous()], 0)


def _stacked(first_pass: FirstPass) -> Tensor:
    """Return the arrays of a first pass, in main memory: [n, T, B] float32."""
    return torch.stack([part for part in first_pass if part is not None]).to("cpu", torch.float32)
