"""Run the attacks and print a verdict on each.

    python -m benchmarks.attack [--slow] [NAME ...]

Without names, all attacks that take less than about 30 s run; with --slow, all of them. Each attack is a file of this
folder with a function of the same name, which returns a Verdict. A file with `SLOW = True` is a slow one. The exit
status is 1 if the service did not hold against each of them.
"""

import argparse
import importlib
import pkgutil
import sys
import time
import traceback
from pathlib import Path

from benchmarks.attack.verdict import Verdict

_NOT_ATTACKS = {"__main__", "verdict"}


def names() -> list[str]:
    """Return the names of all attacks."""
    found = (module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]))
    return sorted(name for name in found if name not in _NOT_ATTACKS and not name.startswith("_"))


def run(name: str) -> Verdict:
    """Run one attack. An exception counts as a service that did not hold."""
    try:
        return getattr(importlib.import_module(f"benchmarks.attack.{name}"), name)()
    except Exception as error:
        traceback.print_exc()
        return Verdict(False, f"{type(error).__name__}: {error}")


def is_slow(name: str) -> bool:
    """Return whether an attack is marked as slow."""
    return getattr(importlib.import_module(f"benchmarks.attack.{name}"), "SLOW", False)


def main() -> int:
    """Run the attacks that the command line names."""
    options = argparse.ArgumentParser(prog="python -m benchmarks.attack")
    options.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(names())}")
    options.add_argument("--slow", action="store_true", help="run the slow attacks too")
    parsed = options.parse_args()
    unknown = set(parsed.names) - set(names())
    if unknown:
        options.error(f"unknown attack {', '.join(sorted(unknown))}: choose from {', '.join(names())}")
    chosen = parsed.names or [name for name in names() if parsed.slow or not is_slow(name)]
    held = True
    for name in chosen:
        began = time.monotonic()
        verdict = run(name)
        held = held and verdict.held
        print(f"{name:<24} {time.monotonic() - began:5.1f} s  {verdict}", flush=True)
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
