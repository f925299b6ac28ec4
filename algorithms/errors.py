"""Errors of algorithms. Without torch, so that a command can import them early."""


class AlgorithmError(Exception):
    """Error of an algorithm that cannot be used in a run. The message is one line."""
