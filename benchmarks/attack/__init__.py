"""Attacks on running processes. Each is a program of its own and a function that returns a Verdict."""

import benchmarks.chaos  # noqa: F401 - adds the helpers of the tests to the path
