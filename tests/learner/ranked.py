"""Several ranks of one learner as threads of the test, connected by a real process group."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from building import run_spec
from torch._C._distributed_c10d import HashStore, Store

from daedalus.learner.ranks.agreement import Options, this_run
from daedalus.learner.ranks.errors import RankLostError, RanksDisagreeError
from daedalus.learner.ranks.follower import Follower
from daedalus.learner.ranks.group import Group
from daedalus.learner.ranks.leader import Leader
from daedalus.learner.training.learner import Learner
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

SECONDS = 60.0


def connected(store: Store, rank: int, number: int, seconds: float = SECONDS) -> Group:
    return Group(store, rank, number, on_this_machine=True, seconds=seconds)


class Rank(threading.Thread):
    """A rank but the first, and how it ended."""

    def __init__(
        self,
        store: Store,
        rank: int,
        number: int,
        options: Options | None = None,
        modules: UserModules = NO_MODULES,
        work: Callable[[Follower], None] = Follower.run,
    ) -> None:
        super().__init__(name=f"rank {rank}", daemon=True)
        self._connect = lambda: connected(store, rank, number)
        self._options, self._modules, self._work = options, modules, work
        self.error: Exception | None = None
        self.follower: Follower | None = None
        self.start()

    def run(self) -> None:
        """Obey rank 0."""
        group = self._connect()
        try:
            self.follower = Follower(group, self._options, self._modules)
            self._work(self.follower)
        except (RankLostError, RanksDisagreeError) as error:
            self.error = error

    def ended(self) -> None:
        """Wait for the end of the rank."""
        self.join(SECONDS)
        assert not self.is_alive()

    @property
    def learner(self) -> Learner:
        """Its learner."""
        assert self.follower is not None
        assert self.follower._learner is not None
        return self.follower._learner


@contextmanager
def ranked_learner(
    number: int,
    spec: RunSpec,
    spaces: Spaces,
    modules: UserModules = NO_MODULES,
    prepare: Callable[[Learner], None] = lambda _: None,
) -> Iterator[tuple[Learner, list[Rank]]]:
    """Give the learner of rank 0, and the other ranks."""
    store = HashStore()
    ranks = [Rank(store, rank, number, modules=modules) for rank in range(1, number)]
    leader = Leader(connected(store, 0, number), this_run(spec, None))
    try:
        learner = Learner(spec.training, spec.policy, spaces, modules, leader)
        prepare(learner)
        random_state = torch.get_rng_state()  # of rank 0: the ranks of a test draw from the same numbers
        leader.begin(spaces, learner.shared_state)
        torch.set_rng_state(random_state)
        yield learner, ranks
    finally:
        leader.close()
        for rank in ranks:
            rank.ended()
    assert not any(rank.error for rank in ranks)


def spec_of(policy: Any, **training: Any) -> RunSpec:
    return run_spec(**training).model_copy(update={"policy": policy})


def assert_equal_state(learner: Learner, ranks: list[Rank]) -> None:
    """Assert that all ranks have ended with the same learned parameters, to the bit."""
    for rank in ranks:
        rank.ended()
        for name in learner.gradient_shapes:
            np.testing.assert_array_equal(learner.weights()[name], rank.learner.weights()[name], name)
        assert rank.learner.policy_version == learner.policy_version
