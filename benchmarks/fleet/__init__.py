"""How the cost of a run grows with its fleet: `python -m benchmarks.fleet`."""
