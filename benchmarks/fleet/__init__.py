"""Measurement of the cost of a run by the number of its actors: `python -m benchmarks.fleet`."""

import benchmarks.chaos  # noqa: F401 - it adds the folder of the tests, whose helpers are used here, to the path
