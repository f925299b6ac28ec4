"""Measure a learner of several processes: batches of the article's network, in samples per second.

    python -m benchmarks.ranks
    python -m benchmarks.ranks --rounds 5 --seconds 20 --rollouts 4

The settings are those of the preset car_racing_article; the rollouts hold random pixels and are in memory already, so
that the figures are of the learner alone: it joins them, shares them out, makes the update, and collects the metrics.
Each learner makes updates of the same batches in turn, so that other load on the machine falls on all of them.
"""

import argparse
import statistics
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks.running import machine, table
from daedalus.cli.ranks import StartedRanks
from daedalus.learner.ranks.leader import NO_OTHER_RANKS, OtherRanks
from daedalus.learner.run.process_resources import keep_freed_memory
from daedalus.learner.run.settings import read_preset, run_spec
from daedalus.learner.training.learner import Learner
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_SPACES = Spaces(
    observations={"observation": ArraySpace(shape=(96, 96), dtype="uint8", frames=4)},
    actions={"action": DiscreteSpace(counts=(4,))},
)
_LEARNERS = [(1, 1), (1, 2), (2, 1)]  # processes, and threads of each


@dataclass(slots=True)
class Measured:
    """One learner, and the durations of its batches in seconds."""

    processes: int
    threads: int
    learner: Learner
    other_ranks: OtherRanks
    rounds: list[float]  # median of each

    def measure(self, batch: list[Rollout], seconds: float, wait: Callable[[], None]) -> None:
        """Make updates for so many seconds, three at least. `wait` keeps the ranks of other learners waiting."""
        torch.set_num_threads(self.threads)
        self.learner.step(batch, 0.0)
        durations: list[float] = []
        ends = time.perf_counter() + seconds
        while time.perf_counter() < ends or len(durations) < 3:
            began = time.perf_counter()
            self.learner.step(batch, 0.0)
            durations.append(time.perf_counter() - began)
            wait()
        self.rounds.append(statistics.median(durations))


def article(precision: str) -> RunSpec:
    """Return the settings of the article's preset."""
    settings = read_preset("car_racing_article")
    settings["training"]["precision"] = precision
    return run_spec(settings)


def random_batch(spec: RunSpec, rollouts: int, state_size: int) -> list[Rollout]:
    """Return the rollouts of one batch."""
    return [_random_rollout(spec, number, state_size) for number in range(rollouts)]


def _random_rollout(spec: RunSpec, number: int, state_size: int) -> Rollout:
    random = np.random.default_rng(number)
    rows, environments = spec.collection.rollout_length, spec.collection.envs_per_actor
    cells, no = (rows, environments), np.zeros((rows, environments), np.bool_)
    return Rollout(
        identity=RolloutIdentity(actor=f"actor-{number}", incarnation=1, sequence=0, learner_epoch=1),
        policy_version=0,
        frames={"observation": random.integers(0, 256, (rows + 4, environments, 96, 96), np.uint8)},
        initial_state=np.zeros((environments, state_size), np.float32),
        actions={"action": random.integers(0, 4, (*cells, 1), np.uint8)},
        masks={},
        behaviour_log_probs=np.full(cells, -1.4, np.float32),
        rewards=random.standard_normal(cells, np.float32),
        terminated=no,
        truncated=no,
        valid=~no,
        episode_returns=np.zeros(0, np.float32),
        episode_lengths=np.zeros(0, np.int32),
    )


def open_learner(spec: RunSpec, processes: int, threads: int, stack: ExitStack) -> Measured:
    """Return a learner of so many processes, which `stack` ends."""
    spec = spec.model_copy(update={"training": spec.training.model_copy(update={"threads": threads})})
    if processes == 1:
        return Measured(processes, threads, Learner(spec.training, spec.policy, _SPACES), NO_OTHER_RANKS, [])
    ranks = stack.enter_context(StartedRanks(processes, []))
    other_ranks = ranks.open(spec, threading.Event())
    assert other_ranks is not None
    stack.callback(other_ranks.close)
    learner = Learner(spec.training, spec.policy, _SPACES, other_ranks=other_ranks)
    other_ranks.begin(_SPACES, learner.shared_state)
    return Measured(processes, threads, learner, other_ranks, [])


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rollouts", type=int, default=2, help="rollouts of a batch, of 8 environments x 15 rows")
    options.add_argument("--precision", choices=("auto", "float32", "bfloat16"), default="auto")
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--seconds", type=float, default=10.0, help="of each learner in each round")
    parsed = options.parse_args()
    keep_freed_memory()
    spec = article(parsed.precision)
    with ExitStack() as stack:
        learners = [open_learner(spec, *size, stack) for size in _LEARNERS]
        batch = random_batch(spec, parsed.rollouts, learners[0].learner.state_size)

        def wait() -> None:
            for each in learners:
                each.other_ranks.wait()

        for _ in range(parsed.rounds):
            for each in learners:
                each.measure(batch, parsed.seconds, wait)
    samples = sum(rollout.env_steps for rollout in batch)
    rates = {(each.processes, each.threads): [samples / seconds for seconds in each.rounds] for each in learners}
    one, two = (statistics.median(rates[size]) for size in ((1, 1), (1, 2)))
    rows = [
        (
            processes,
            threads,
            f"{statistics.median(rate):,.0f}",
            f"{min(rate):,.0f} to {max(rate):,.0f}",
            f"{statistics.median(rate) / one:.2f}",
            f"{statistics.median(rate) / two:.2f}",
        )
        for (processes, threads), rate in rates.items()
    ]
    print(f"{machine()}, torch {torch.__version__}, batches of {samples} samples, precision {parsed.precision}")
    header = ("processes", "threads of each", "samples/s", "rounds", "x one thread", "x one process of two threads")
    print(table(header, rows))


if __name__ == "__main__":
    main()
