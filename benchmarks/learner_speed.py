"""Samples a second of the learner's networks alone: forward, backward, gradient's norm, Adam. No actors, no transport.

    python benchmarks/learner_speed.py
    python benchmarks/learner_speed.py --networks nature article --threads 1 --seconds 10 --profile
    python benchmarks/learner_speed.py --networks nature --actors 2

The fastest of several updates counts: what else runs on the machine only ever makes one slower. With --actors, as many
processes that play Pong beside it, at the same priority: then all updates count, against the mean of those alone times
what is the learner's by right: of C cores, with N actors and T threads, T or C T / (T + N), whichever is less.
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
from running import machine, table

from daedalus.algorithms.flat_parameters import FlatParameters
from daedalus.learner.training.allocator import keep_freed_memory
from daedalus.learner.training.optimizers import Adam
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec

# Name: policy, observations, rows, environments.
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
    """A function that learns once from the same random batch."""
    network = ActorCritic(policy, Spaces(observation=space, action=DiscreteSpace(count=6)))
    flat = FlatParameters(network.parameters())
    optimizer = Adam(flat.values, 1e-5)
    shape = (rows, environments, *space.stacked_shape)
    observations = torch.randint(0, 256, shape).to(getattr(torch, space.dtype))
    state = torch.zeros(environments, network.state_size)
    starts = torch.rand(rows, environments) < 0.02
    actions = torch.randint(0, 6, (rows, environments, 1))

    def update() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            logits, values = network(observations, state, starts)
        loss = values.square().mean() - logits.log_softmax(-1).gather(-1, actions).mean()
        flat.gradients.zero_()
        loss.backward()
        flat.clip_gradients(0.5)
        optimizer.step(flat.values, flat.gradients, 1e-4)

    return update


def fastest(update: Callable[[], None], seconds: float) -> float:
    """Seconds of the fastest update within so many seconds, three at least."""
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
def busy_actors(count: int) -> Iterator[None]:
    """So many processes play beside it."""
    command = [sys.executable, str(Path(__file__).parent / "busy_actor.py")]
    actors: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(count):
            actors.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        for actor in actors:
            if actor.stdout is None or actor.stdout.readline() != b"busy\n":
                raise SystemExit("an actor could not play: see what it said above")
        yield
    finally:
        for actor in actors:
            actor.communicate()  # ends its standard input


def beside(update: Callable[[], None], threads: int, actors: int, seconds: float) -> tuple[float, float]:
    """Seconds of the mean update beside busy actors; and of what a fair share of the cores would make of it."""
    alone = statistics.mean(_durations(update, seconds))
    with busy_actors(actors):
        shared = statistics.mean(_durations(update, seconds))
    cores = os.cpu_count() or 1
    return shared, alone * threads / min(threads, cores * threads / (threads + actors))


def profile(update: Callable[[], None]) -> str:
    """Where three updates spend their time."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profiler:
        for _ in range(3):
            update()
    return profiler.key_averages().table(sort_by="self_cpu_time_total", row_limit=25, max_name_column_width=60)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--networks", nargs="+", choices=NETWORKS, default=list(NETWORKS))
    options.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    options.add_argument("--precisions", nargs="+", choices=("float32", "bfloat16"), default=["float32", "bfloat16"])
    options.add_argument("--seconds", type=float, default=3.0, help="for each figure")
    options.add_argument("--profile", action="store_true", help="say where the time goes")
    options.add_argument("--actors", type=int, default=0, metavar="N", help="measure it beside N busy actors as well")
    parsed = options.parse_args()
    keep_freed_memory()
    header = ("network", "rows x environments", "threads", "precision", "samples/s")
    if parsed.actors:
        header += (f"beside {parsed.actors} actors", "its fair share", "of that")
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
