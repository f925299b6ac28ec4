"""What every rank but the first does: it obeys rank 0, and holds the same parameters. No files, no actors."""

import logging
import socket
from dataclasses import replace

import torch
from pydantic import ValidationError

from daedalus.algorithms.batch import BatchAssembler
from daedalus.algorithms.errors import AlgorithmError
from daedalus.algorithms.ranks import RankPart
from daedalus.learner.ranks.agreement import Options, checked
from daedalus.learner.ranks.commands import Command, CommandKind, receive
from daedalus.learner.ranks.errors import RanksDisagreeError
from daedalus.learner.ranks.group import Group
from daedalus.learner.ranks.leader import exchange, report_first_pass
from daedalus.learner.ranks.parts import bounds_of
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.learner import Learner
from daedalus.policy.user_code import message_line
from daedalus.policy.user_modules import NO_MODULES, NetworkError, UserModuleError, UserModules
from daedalus.protocol.spaces import Spaces

_logger = logging.getLogger(__name__)


class Follower:
    """One rank that computes gradients with rank 0."""

    def __init__(
        self, group: Group, options: Options | None = None, modules: UserModules = NO_MODULES, local_rank: int = 0
    ) -> None:
        """Learn from rank 0 what the run is.

        Args:
          group: the ranks.
          options: of the command line; None if rank 0 has started this process.
          modules: that this process may import.
          local_rank: which GPU of this machine it uses.

        Raises RanksDisagreeError or RankLostError.
        """
        self._group, self._modules = group, modules
        try:
            self._spec = checked(group.announce(), options)
            if self._spec.training.device == "cuda":
                group.use_gpu(local_rank)
        except (RanksDisagreeError, SettingsError) as error:
            raise self._refused(error) from None
        group.report()
        self._learner: Learner | None = None
        self._assembler: BatchAssembler | None = None

    def run(self) -> None:
        """Obey rank 0 until it ends the run. Raises RanksDisagreeError or RankLostError."""
        while (command := receive(self._group)).kind is not CommandKind.END:
            if command.kind is CommandKind.BEGIN:
                self._begin()
            elif command.kind is CommandKind.STATE:
                exchange(self._group, self._built.shared_state())
            elif command.kind is CommandKind.BATCH:
                self._update(command)

    @property
    def _built(self) -> Learner:
        assert self._learner is not None, "rank 0 has not begun"
        return self._learner

    def _begin(self) -> None:
        """Construct the learner, with the state of rank 0's."""
        try:
            spaces = Spaces.model_validate_json(self._group.announce())
            self._learner = Learner(self._spec.training, self._spec.policy, spaces, self._modules)
        except (AlgorithmError, NetworkError, SettingsError, UserModuleError, ValidationError) as error:
            raise self._refused(error) from None
        self._group.report()
        exchange(self._group, self._learner.shared_state())
        self._assembler = BatchAssembler(spaces, self._learner.device)
        _logger.debug("rank %d of %d takes part", self._group.rank, self._group.number)

    def _refused(self, error: Exception) -> RanksDisagreeError:
        """Report an error to rank 0, and return it with the name of this rank."""
        text = f"rank {self._group.rank} on {socket.gethostname()}: {message_line(error)}"
        self._group.report(text)
        return RanksDisagreeError(text)

    def _update(self, command: Command) -> None:
        """Make the updates of a batch."""
        group, learner = self._group, self._built
        assert self._assembler is not None
        valid = torch.zeros(command.rows, command.environments)
        exchange(group, [*learner.constants, valid])
        first, end = bounds_of(command.environments, group.number)[group.rank]
        batch = self._assembler.allocate(command.rows, max(end - first, 1), learner.state_size)
        group.receive(batch.tensors(), 0)
        part = RankPart(ranks=group, first=first, end=end, valid=valid, updates=command.end - command.version)
        learner.policy_version = command.version
        learned = learner.learn_from(replace(batch, rank_part=part), command.progress, command.end)
        if learned and learner.first_pass is not None:
            report_first_pass(group, learner.first_pass, end - first)
