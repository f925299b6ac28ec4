"""Errors of training that a command reports in one line. Without torch, so that a command can import them early."""


class CheckpointMismatchError(Exception):
    """Error for a checkpoint of another network or optimiser."""
