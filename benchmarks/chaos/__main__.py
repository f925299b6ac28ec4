"""Cause every kind of fault and print what happened, in one table.

python -m benchmarks.chaos                     all sections, within 40 minutes on two cores
python -m benchmarks.chaos freezes fuzz        only these sections
python -m benchmarks.chaos --scale 0.1 ...     a tenth of the faults
"""

import argparse
import sys
import time

from benchmarks.chaos import (
    actors,
    clocks,
    disk,
    endings,
    league_results,
    learners,
    network,
    orders,
    replay,
    slow,
    wire,
)
from benchmarks.chaos.scene import FailedError, say
from benchmarks.running import machine, table


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("sections", nargs="*", metavar="SECTION", help="sections to run (default: all)")
    options.add_argument("--scale", type=float, default=1.0, help="factor on the number of faults (default: 1.0)")
    arguments = options.parse_args()

    def scaled(events: int) -> int:
        return max(round(events * arguments.scale), 1)

    sections = {
        "kills": lambda: actors.kills(scaled(100)),
        "barriers": lambda: actors.barriers(scaled(12)),
        "freezes": lambda: actors.freezes(scaled(20)),
        "accounting": lambda: actors.accounting(scaled(30)),
        "league": lambda: league_results.league(scaled(40)),
        "replay": lambda: replay.replay(scaled(40)),
        "learners": lambda: learners.kills(scaled(50)),
        "ends": lambda: endings.run_ends(scaled(100)),
        "restarts": lambda: endings.restarts(scaled(100)),
        "splits": lambda: learners.splits(scaled(6)),
        "standing": lambda: endings.standing(scaled(6)),
        "stops": lambda: learners.stops(scaled(8)),
        "routers": lambda: network.routers(scaled(20)),
        "cuts": lambda: network.cuts(30.0 if arguments.scale >= 1.0 else 8.0, scaled(2)),
        "orders": lambda: orders.orders(scaled(12)),
        "disk": lambda: disk.slow(15.0, max(40.0 * arguments.scale, 20.0)),
        "checkpoints": lambda: learners.damaged(scaled(1000)),
        "overload": lambda: wire.overload(max(60.0 * arguments.scale, 10.0)),
        "subscriber": lambda: wire.slow_subscriber(max(20.0 * arguments.scale, 5.0)),
        "clocks": lambda: clocks.steps(max(10.0 * arguments.scale, 3.0)),
        "slow": lambda: slow.slow(max(600.0 * arguments.scale, 150.0)),
        "simulators": lambda: replay.simulators(scaled(3)),
        "fuzz": lambda: wire.fuzz(scaled(1_000_000)),
        "solve": lambda: actors.solve(scaled(3)),
    }
    unknown = set(arguments.sections) - sections.keys()
    if unknown:
        options.error(f"unknown section {', '.join(sorted(unknown))}: choose from {', '.join(sections)}")
    rows, failed, began = [], False, time.monotonic()
    for name in arguments.sections or sections:
        say(f"--- {name}")
        section_began = time.monotonic()
        try:
            found = sections[name]()
        except FailedError as error:
            found, failed = [("FAILED", str(error))], True
            say(f"FAILED: {error}")
        taken = f"{time.monotonic() - section_began:.0f} s"
        rows += [(name if not index else "", *row, taken if not index else "") for index, row in enumerate(found)]
    print(f"{machine()}; {(time.monotonic() - began) / 60:.1f} minutes\n")
    print(table(("section", "measurement", "result", "duration"), rows))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
