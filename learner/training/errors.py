"""Errors of training that a command reports in one line; torch-free, so that it can name them before torch loads."""


class CheckpointMismatchError(Exception):
    """A checkpoint that another network or optimiser wrote."""
