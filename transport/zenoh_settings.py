"""The Zenoh configuration of our sessions and of a stand-alone zenohd. Pure functions; Zenoh is not imported.

Endpoints are explicit: multicast and gossip discovery are off. Shared memory is off.
"""

from typing import Any, Literal

_LEASE_MILLISECONDS = 2000  # a peer that is silent for longer is disconnected
_MOST_SESSIONS = 20_000  # per router; Zenoh's default of 1,000 refuses the rest of a large fleet silently
_RETRY_MILLISECONDS = 100  # until a client retries a lost router; doubles up to ten times this


def session_settings(
    mode: Literal["router", "client"], listen: list[str], connect: list[str], security: dict[str, Any]
) -> dict[str, Any]:
    """Return the value of each setting by its path; `security` comes from Credentials.settings, or is empty."""
    return {
        "mode": mode,
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/timeout_ms": 0 if mode == "client" else -1,  # a router retries other routers for ever
        "connect/exit_on_failure": mode == "client",
        "connect/retry": {
            "period_init_ms": _RETRY_MILLISECONDS,
            "period_max_ms": 10 * _RETRY_MILLISECONDS,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # otherwise a router waits half a second for discovery
        "transport/link/tx/lease": _LEASE_MILLISECONDS,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_sessions": _MOST_SESSIONS,
        **security,
    }


def as_config_file(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings as nested maps, one level for each part of a path, as a configuration file has them."""
    root: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, last = path.split("/")
        section = root
        for parent in parents:
            section = section.setdefault(parent, {})
        section[last] = value
    return root
