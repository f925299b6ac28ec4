"""What can be wrong with a network before it has learned anything."""


class NetworkError(ValueError):
    """The network of a PolicySpec cannot be built for the spaces; the message says why and what to do."""
