"""Errors of policies at an actor."""


class PolicyError(Exception):
    """A program or weights that do not fit together or do not fit the spaces: a fault of the sender."""
