"""Errors in building a network."""


class NetworkError(Exception):
    """The network of a PolicySpec cannot be built for the spaces; the message says why and what to do."""
