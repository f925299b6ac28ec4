"""Measure the time from the start of an actor to its first accepted rollout, and its memory, over loopback.

python -m benchmarks.thin_actor --times 10
"""

import argparse
import sys
import time

import numpy as np

from benchmarks.chaos.scene import ENDLESS, Scene, resident_mib, say, scene
from benchmarks.running import machine, table


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument(
        "--times", type=int, default=10, help="number of actors, one after the other (default: %(default)s)"
    )
    options.add_argument("--preset", default="cartpole", help="preset of the run (default: %(default)s)")
    parsed = options.parse_args()
    with scene() as here:
        here.start("learner", parsed.preset, "--listen", here.address, "--run-dir", "run", "--actors", 1, *ENDLESS)
        here.start("actor", "--connect", here.address, "--name", "first")
        here.wait_for_training()
        measured = [_one(here, f"thin-{number}") for number in range(parsed.times)]
    seconds, mib = np.array(measured).T
    rows = [
        ("start to first accepted rollout, s", f"{np.median(seconds):.2f}", f"{seconds.max():.2f}"),
        ("resident, MiB", f"{np.median(mib):.0f}", f"{mib.max():.0f}"),
    ]
    print(f"{machine()}; {parsed.preset}, {parsed.times} actors one after the other, while another plays\n")
    print(table(("", "median", "worst"), rows))
    return 0


def _one(here: Scene, name: str) -> tuple[float, float]:
    """Return the seconds until the first accepted rollout of a new actor, and its memory one second later."""
    began = time.monotonic()
    running = here.start("actor", "--connect", here.address, "--name", name)

    def contributes() -> bool:
        actor = here.actor(name)
        return actor is not None and actor.rollouts_accepted > 0

    here.wait(f"a rollout of {name}", contributes)
    seconds = time.monotonic() - began
    time.sleep(1.0)
    mib = resident_mib(running.process.pid)
    running.process.terminate()
    running.wait()
    say(f"{name}: {seconds:.2f} s, {mib:.0f} MiB")
    return seconds, mib


if __name__ == "__main__":
    sys.exit(main())
