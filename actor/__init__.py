"""Actors: environments, rollouts, and the session that streams them to a learner. No torch unless asked for.

`Client` is an actor in a loop that the caller owns: see actor/client.py.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from daedalus.actor.client import Client

__all__ = ["Client"]


def __getattr__(name: str) -> Any:
    """Import Client on first use: nothing else here needs the network."""
    if name == "Client":
        from daedalus.actor.client import Client

        return Client
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
