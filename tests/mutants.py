"""Print which share of the mutants of `make mutants` a test has noticed; fail below 95 %.

Runs in the folder of the mutants. tests/mutants.md lists those that no test notices, each with the reason.
"""

import json
import subprocess
import sys
from pathlib import Path

_REQUIRED = 0.95


def main() -> int:
    """Return the exit status: 0 if enough mutants were noticed."""
    counts = json.loads(Path("mutants/mutmut-cicd-stats.json").read_text("utf-8"))
    noticed = counts["killed"] + counts["timeout"] + counts.get("segfault", 0)
    unnoticed = counts["survived"] + counts["no_tests"] + counts["suspicious"]
    share = noticed / (noticed + unnoticed)
    print(
        subprocess.run([sys.executable, "-m", "mutmut", "results"], capture_output=True, text=True, check=True).stdout
    )
    print(
        f"{noticed} of {noticed + unnoticed} mutants noticed: {100 * share:.1f} %, {100 * _REQUIRED:.0f} % are required"
    )
    return 0 if share >= _REQUIRED else 1


if __name__ == "__main__":
    sys.exit(main())
