"""What the service promises under faults, in figures: `python -m benchmarks.chaos [SECTION ...]`."""

import sys
from pathlib import Path

# The faults themselves, a stalling link among them, are made by the same files as in the tests.
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
