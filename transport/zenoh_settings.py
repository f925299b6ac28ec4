"""How Zenoh is configured, here and in a zenohd of Eclipse's: one place for both. Pure; does not import it.

Multicast and gossip are off, endpoints are explicit, nothing is sent over shared memory.
"""

from typing import Any, Literal

_LEASE_MILLISECONDS = 2000  # a peer that is silent for as long is gone
_MOST_SESSIONS = 20_000  # with one router; Zenoh's own default, 1,000, keeps the rest of a fleet out without a word
_RETRY_MILLISECONDS = 100  # how soon a client tries again after its router vanished; doubles up to ten times this


def session_settings(
    mode: Literal["router", "client"], listen: list[str], connect: list[str], security: dict[str, Any]
) -> dict[str, Any]:
    """By the path of each setting, its value; `security` is that of Credentials.settings, or empty."""
    return {
        "mode": mode,
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/timeout_ms": 0 if mode == "client" else -1,  # a router that is told of another goes on trying
        "connect/exit_on_failure": mode == "client",
        "connect/retry": {
            "period_init_ms": _RETRY_MILLISECONDS,
            "period_max_ms": 10 * _RETRY_MILLISECONDS,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # else a router waits half a second for peers that it could scout
        "transport/link/tx/lease": _LEASE_MILLISECONDS,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_sessions": _MOST_SESSIONS,
        **security,
    }


def as_config_file(settings: dict[str, Any]) -> dict[str, Any]:
    """The same as a configuration file holds it: a map for each part of a path."""
    root: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, last = path.split("/")
        place = root
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    return root
