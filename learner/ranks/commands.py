"""What rank 0 tells the other ranks to do: one small tensor for each command."""

from dataclasses import astuple, dataclass
from enum import IntEnum

import torch

from daedalus.learner.ranks.errors import RankLostError
from daedalus.learner.ranks.group import Group

_MOST_ROWS, _MOST_ENVIRONMENTS = 4096, 1 << 20  # of a batch


class CommandKind(IntEnum):
    """What to do."""

    WAIT = 0  # for the next command; rank 0 is alive
    BEGIN = 1  # construct the learner of the spaces that follow, and take over the state
    STATE = 2  # take over the state that follows
    BATCH = 3  # make the updates of a batch, whose part follows
    END = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """One command. All but `kind` are of a batch."""

    kind: CommandKind
    rows: int = 0  # T
    environments: int = 0  # B of the whole batch
    version: int = 0  # policy version before its updates
    end: int = 0  # and after them
    progress: float = 0.0  # share of the budget that is used


def give(group: Group, command: Command) -> None:
    """Give a command to all other ranks. Raises RankLostError."""
    group.first(torch.tensor(astuple(command), dtype=torch.float64))


def receive(group: Group) -> Command:
    """Wait for the next command of rank 0. Raises RankLostError."""
    values = group.first(torch.zeros(6, dtype=torch.float64)).tolist()
    kind, rows, environments, version, end = map(int, values[:5])
    if not (0 <= rows <= _MOST_ROWS and 0 <= environments <= _MOST_ENVIRONMENTS and 0 <= end - version):
        raise RankLostError(f"rank 0 announces a batch of {rows} rows of {environments} environments: end the run")
    return Command(
        kind=CommandKind(kind), rows=rows, environments=environments, version=version, end=end, progress=values[5]
    )
