"""Plays: environments, the collector, the service that streams rollouts to a learner. No torch by default.

`Client` is for loops that are not ours: see actor/client.py.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from daedalus.actor.client import Client

__all__ = ["Client"]


def __getattr__(name: str) -> Any:
    """Loads Client when it is asked for: nothing else here needs the network."""
    if name == "Client":
        from daedalus.actor.client import Client

        return Client
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
