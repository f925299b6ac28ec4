"""Measurement of the cost of a run by the number of its actors: `python -m benchmarks.fleet`."""
