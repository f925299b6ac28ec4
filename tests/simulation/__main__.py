"""Simulate the session protocol for many seeds.

python -m tests.simulation                        1,000 seeds
python -m tests.simulation --seeds 100000         more of them; about 10 ms a seed on an idle core
python -m tests.simulation --from 4711 --seeds 1 --trace     one seed, with everything that happened

Exit status: 0 without a violation, 1 with one. A violation prints the last events of its seed, and the command that
repeats it.
"""

import argparse
import logging
import os
import sys
import time

from .simulate import Result, simulate

_SHOWN = 60  # lines of the trace of a failure
_REPORT_SECONDS = 30.0


def main() -> int:
    """Run the simulations of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from", dest="first", type=int, default=0, metavar="SEED", help="first seed (default: 0)")
    parser.add_argument("--seeds", type=int, default=1000, metavar="N", help="number of seeds (default: 1000)")
    parser.add_argument("--trace", action="store_true", help="print every event")
    parser.add_argument("--keep-going", action="store_true", help="go on after a violation")
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    _use_one_core()
    began = reported = time.monotonic()
    failed, slowest, rollouts, done = 0, 0.0, 0, 0
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        result = simulate(seed)
        done += 1
        slowest, rollouts = max(slowest, result.seconds_to_progress), rollouts + result.rollouts
        if arguments.trace:
            print("\n".join(result.lines))
        if result.failure is not None:
            failed += 1
            _print_failure(result, shown=not arguments.trace)
            if not arguments.keep_going:
                break
        if time.monotonic() > reported + _REPORT_SECONDS:
            reported = time.monotonic()
            print(f"{done:,} seeds in {reported - began:.0f} s, {failed} violations", flush=True)
    seconds = time.monotonic() - began
    print(
        f"{done:,} seeds from {arguments.first}: {failed} violations; {rollouts:,} rollouts; "
        f"progress at most {slowest:.1f} virtual seconds after the last fault; {seconds:.0f} s, "
        f"{1000 * seconds / done:.1f} ms a seed"
    )
    return int(failed > 0)


def _use_one_core() -> None:
    """Run all threads on one core: only one of them runs at a time, and a switch between two cores is slow."""
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[os.getpid() % len(cores)]})


def _print_failure(result: Result, *, shown: bool) -> None:
    if shown:
        print(f"--- the last {_SHOWN} events of seed {result.seed}")
        print("\n".join(result.lines[-_SHOWN:]))
    print(f"--- seed {result.seed}: {type(result.failure).__name__}: {result.failure}")
    print(f"--- repeat it: python -m tests.simulation --from {result.seed} --seeds 1 --trace", flush=True)


if __name__ == "__main__":
    sys.exit(main())
