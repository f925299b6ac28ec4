"""Measure updates of the learner's networks, in samples per second: forward, backward, gradient norm, Adam.

    python -m benchmarks.learner_speed
    python -m benchmarks.learner_speed --networks nature article --threads 1 --seconds 10 --profile
    python -m benchmarks.learner_speed --networks nature --actors 2

There are no actors and no transport. The result is the fastest of several updates, because other load on the machine
can only slow an update down. With --actors N, the mean update is also measured while N processes play Pong at the same
priority. It is compared with the mean update without them, scaled by the fair share of the learner: with C cores and T
threads, the fair share is min(T, C T / (T + N)) cores.
"""

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from benchmarks.running import machine, table
from daedalus.algorithms.forward import FlatParameters
from daedalus.learner.run.process_resources import keep_freed_memory
from daedalus.learner.training.optimizers import Adam
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec

# By name: policy, observation space, rows, environments.
NETWORKS: dict[str, tuple[PolicySpec, ArraySpace, int, int]] = {
    "nature": (PolicySpec(encoder="nature"), ArraySpace(shape=(84, 84), dtype="uint8", frames=4), 16, 16),
    "impala": (PolicySpec(encoder="impala"), ArraySpace(shape=(84, 84), dtype="uint8", frames=4), 16, 16),
    "article": (PolicySpec(encoder="article"), ArraySpace(shape=(96, 96), dtype="uint8", frames=4), 15, 16),
    "article, gru": (
        PolicySpec(encoder="article", memory="gru"),
        ArraySpace(shape=(96, 96), dtype="uint8", frames=4),
        15,
        16,
    ),
    "mlp": (PolicySpec(), ArraySpace(shape=(4,), dtype="float32"), 16, 128),
    "mlp, gru": (PolicySpec(memory="gru"), ArraySpace(shape=(4,), dtype="float32"), 16, 128),
}


def updater(policy: PolicySpec, space: ArraySpace, rows: int, environments: int, bfloat16: bool) -> Callable[[], None]:
    """Return a function that makes one update from the same random batch."""
    network = ActorCritic(
        policy, Spaces(observations={"observation": space}, actions={"action": DiscreteSpace(counts=(6,))})
    )
    flat = FlatParameters(network.learned_parameters())
    optimizer = Adam(flat.values, 1e-5)
    rate, skipped = flat.values.new_tensor(1e-4), flat.values.new_zeros(())
    shape = (rows, environments, *space.stacked_shape)
    observations = torch.randint(0, 256, shape).to(getattr(torch, space.dtype))
    state = torch.zeros(environments, network.state_size)
    starts = torch.rand(rows, environments) < 0.02
    actions = torch.randint(0, 6, (rows, environments, 1))

    def update() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            logits, values = network({"observation": observations}, state, starts)
        loss = values.square().mean() - logits.log_softmax(-1).gather(-1, actions).mean()
        flat.gradients.copy_(flat.differentiated(loss))
        flat.clip_gradients(0.5)
        optimizer.step(flat.values, flat.gradients, rate, skipped)

    return update


def fastest(update: Callable[[], None], seconds: float) -> float:
    """Return the duration of the fastest update in seconds. Measure for `seconds`, and at least three updates."""
    return min(_durations(update, seconds))


def _durations(update: Callable[[], None], seconds: float) -> list[float]:
    update()
    durations: list[float] = []
    ends = time.perf_counter() + seconds
    while time.perf_counter() < ends or len(durations) < 3:
        began = time.perf_counter()
        update()
        durations.append(time.perf_counter() - began)
    return durations


@contextlib.contextmanager
def busy_actors(count: int, *options: str) -> Iterator[list[tuple[float, ...]]]:
    """Run `count` processes that play Pong. Yield a list, which has what each printed at its end after the block."""
    command = [sys.executable, str(Path(__file__).parent / "busy_actor.py"), *options]
    ends: list[tuple[float, ...]] = []
    actors: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(count):
            actors.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        for actor in actors:
            if actor.stdout is None or actor.stdout.readline() != b"busy\n":
                raise SystemExit("an actor process failed: see its error message above")
        yield ends
    finally:
        for actor in actors:
            if actor.stdin is not None:
                actor.stdin.close()  # which ends it
                actor.stdin = None  # as `communicate` requires
        ends += [tuple(map(float, actor.communicate()[0].split())) for actor in actors]


def beside(update: Callable[[], None], threads: int, actors: int, seconds: float) -> tuple[float, float]:
    """Return the mean duration of an update with busy actors, and the duration expected from the fair share."""
    alone = statistics.mean(_durations(update, seconds))
    with busy_actors(actors):
        shared = statistics.mean(_durations(update, seconds))
    cores = os.cpu_count() or 1
    return shared, alone * threads / min(threads, cores * threads / (threads + actors))


def profile(update: Callable[[], None]) -> str:
    """Return a table of the time spent in each operation, over three updates."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profiler:
        for _ in range(3):
            update()
    return profiler.key_averages().table(sort_by="self_cpu_time_total", row_limit=25, max_name_column_width=60)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--networks", nargs="+", choices=NETWORKS, default=list(NETWORKS))
    options.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    options.add_argument("--precisions", nargs="+", choices=("float32", "bfloat16"), default=["float32", "bfloat16"])
    options.add_argument("--seconds", type=float, default=3.0, help="duration of each measurement")
    options.add_argument("--profile", action="store_true", help="print the time of each operation")
    options.add_argument("--actors", type=int, default=0, metavar="N", help="measure also with N busy actors")
    parsed = options.parse_args()
    keep_freed_memory()
    header = ("network", "rows x environments", "threads", "precision", "samples/s")
    if parsed.actors:
        header += (f"with {parsed.actors} actors", "fair share", "ratio")
    rows: list[tuple[object, ...]] = []
    for name in parsed.networks:
        policy, space, length, environments = NETWORKS[name]
        for threads in parsed.threads:
            torch.set_num_threads(threads)
            for precision in parsed.precisions:
                update = updater(policy, space, length, environments, precision == "bfloat16")
                samples = length * environments
                rate = samples / fastest(update, parsed.seconds)
                rows.append((name, f"{length} x {environments}", threads, precision, f"{rate:,.0f}"))
                if parsed.actors:
                    shared, fair = beside(update, threads, parsed.actors, parsed.seconds)
                    rows[-1] += (f"{samples / shared:,.0f}", f"{samples / fair:,.0f}", f"{fair / shared:.2f}")
                if parsed.profile:
                    print(rows[-1], profile(update), sep="\n")
    print(machine())
    print(table(header, rows))


if __name__ == "__main__":
    main()
