"""Measurements of the service under faults: `python -m benchmarks.chaos [SECTION ...]`."""

import sys
from pathlib import Path

# The helpers that cause the faults are those of the tests.
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
