"""Samples a second of the learner's networks alone: forward, backward, gradient's norm, Adam. No actors, no transport.

    python benchmarks/learner_speed.py
    python benchmarks/learner_speed.py --networks nature article --threads 1 --seconds 10 --profile

The fastest of several updates counts: what else runs on the machine only ever makes one slower.
"""

import argparse
import time
from collections.abc import Callable

import torch
from running import machine, table

from learner.allocator import keep_freed_memory
from learner.optimizers import Adam, FlatParameters
from policy.network import ActorCritic
from protocol.spec import ArraySpace, ChoiceSpace, PolicySpec, Spaces

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
    network = ActorCritic(policy, Spaces(observation=space, action=ChoiceSpace(count=6)))
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
    update()
    durations: list[float] = []
    ends = time.perf_counter() + seconds
    while time.perf_counter() < ends or len(durations) < 3:
        began = time.perf_counter()
        update()
        durations.append(time.perf_counter() - began)
    return min(durations)


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
    parsed = options.parse_args()
    keep_freed_memory()
    rows = []
    for name in parsed.networks:
        policy, space, length, environments = NETWORKS[name]
        for threads in parsed.threads:
            torch.set_num_threads(threads)
            for precision in parsed.precisions:
                update = updater(policy, space, length, environments, precision == "bfloat16")
                rate = length * environments / fastest(update, parsed.seconds)
                rows.append((name, f"{length} x {environments}", threads, precision, f"{rate:,.0f}"))
                if parsed.profile:
                    print(rows[-1], profile(update), sep="\n")
    print(machine())
    print(table(("network", "rows x environments", "threads", "precision", "samples/s"), rows))


if __name__ == "__main__":
    main()
