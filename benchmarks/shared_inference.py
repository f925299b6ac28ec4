"""Measure env_steps/s of Pong with actors that run their own policy, and with one process that runs it for all of them.

    python -m benchmarks.shared_inference --actors 14 --inference cuda

The actors collect and encode rollouts of 8 environments (backend ale, Nature's network); nobody learns. Every half
second they load other weights. The CPU time is that of the actors and of the process of their policy. Both ways run in
turn in each round, and ratios are computed per round.
"""

import argparse
import os
import statistics
import time
from pathlib import Path

from benchmarks.learner_speed import busy_actors
from benchmarks.running import machine, table
from daedalus.launch.supervision import Inference, Supervised, stop, supervised_inference
from daedalus.transport.private_address import private_folder


def measure(inference: Inference, actors: int, seconds: float) -> tuple[float, float]:
    """Return the env_steps/s of all actors together, and the microseconds of CPU time of an env_step."""
    with private_folder() as folder:
        processes, options = supervised_inference(inference, folder, ["--log-level", "warning"])
        try:
            with busy_actors(actors, "--encoder", "nature", *options) as ends:
                before = sum(map(cpu_seconds, processes))
                time.sleep(seconds)
                spent = sum(map(cpu_seconds, processes)) - before
            rate = sum(steps / took for steps, took, _ in ends)
            cpu = spent / seconds + sum(used / took for _, took, used in ends)
            return rate, 1e6 * cpu / rate
        finally:
            stop([each.process for each in processes])


def cpu_seconds(process: Supervised) -> float:
    fields = Path(f"/proc/{process.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--actors", type=int, nargs="+", default=[2, 4], help="numbers of actors (default: 2 and 4)")
    options.add_argument("--inference", choices=("shared", "cuda"), default="shared", help="the other way to measure")
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--seconds", type=float, default=15.0, help="duration of each measurement")
    parsed = options.parse_args()
    rows = []
    for actors in parsed.actors:
        ratios = []
        for index in range(parsed.rounds):
            (local, cpu), (other, other_cpu) = (
                measure(each, actors, parsed.seconds) for each in ("local", parsed.inference)
            )
            ratios.append(other / local)
            spent = f"{cpu:.0f}", f"{other_cpu:.0f}"
            rows.append((actors, index + 1, f"{local:,.0f}", f"{other:,.0f}", f"{ratios[-1]:.2f}", *spent))
        rows.append((actors, "median", "", "", f"{statistics.median(ratios):.2f}", "", ""))
    print(machine())
    print(
        table(
            ("actors", "round", "local, env_steps/s", f"{parsed.inference}, env_steps/s", "ratio", "CPU us", "CPU us"),
            rows,
        )
    )


if __name__ == "__main__":
    main()
