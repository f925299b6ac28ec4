"""The Zenoh configuration of our sessions and of a stand-alone zenohd. Pure functions; Zenoh is not imported.

Endpoints are explicit: multicast and gossip discovery are off. Shared memory is off.
"""

from dataclasses import dataclass
from typing import Any, Literal

from daedalus.protocol import keys
from daedalus.protocol.limits import EVALUATION_LIMITS, JOIN_LIMITS

MAX_MESSAGE_BYTES = 64 << 20  # of a session that does not know the sizes of a run, such as a router's

_LEASE_MILLISECONDS = 2000  # a peer that is silent for longer is disconnected
_MOST_SESSIONS = 20_000  # per router; Zenoh's default of 1,000 refuses the rest of a large fleet silently
_RETRY_MILLISECONDS = 100  # until a client retries a lost router; doubles up to ten times this
_ACCEPT_MILLISECONDS = 5000  # for a new connection to identify itself; then it is closed
# Connections that have not identified themselves yet. With Zenoh's default of 100, as many silent connections keep
# every actor from joining.
_MOST_PENDING = 4096
# Batches of 64 kB that wait for a link. A snapshot has many: with Zenoh's default of 2, its sender waits for each. A
# router has a link to each actor, so it keeps the default.
_CLIENT_QUEUE = 16
_DESCRIPTORS = 65_536  # of a process whose limit is not known, such as zenohd


@dataclass(frozen=True, slots=True, kw_only=True)
class Capacity:
    """What one session accepts from its peers.

    Attributes:
      message_bytes: largest message. Zenoh drops a larger one while it arrives.
      descriptors: file descriptors that the process may have open. Connections may use three quarters of them.
    """

    message_bytes: int = MAX_MESSAGE_BYTES
    descriptors: int = _DESCRIPTORS

    @property
    def sessions(self) -> int:
        """Largest number of peers."""
        return min(self.descriptors // 2, _MOST_SESSIONS)

    @property
    def pending(self) -> int:
        """Largest number of connections that have not identified themselves yet."""
        return min(self.descriptors // 4, _MOST_PENDING)


def session_settings(
    mode: Literal["router", "client"],
    listen: list[str],
    connect: list[str],
    security: dict[str, Any],
    capacity: Capacity,
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
        "transport/link/rx/max_message_size": capacity.message_bytes,
        "transport/shared_memory/enabled": False,
        **({"transport/link/tx/queue/size/data": _CLIENT_QUEUE} if mode == "client" else {}),
        "transport/unicast/max_sessions": capacity.sessions,
        "transport/unicast/accept_pending": capacity.pending,
        "transport/unicast/accept_timeout": _ACCEPT_MILLISECONDS,
        **({"low_pass_filter": _small_queries()} if listen else {}),
        **security,
    }


def _small_queries() -> list[dict[str, Any]]:
    """Return Zenoh's `low_pass_filter` for queries that are small: a router does not forward larger ones."""

    def rule(name: str, size: int, *key_expressions: str) -> dict[str, Any]:
        return {
            "id": name,
            "flows": ["ingress"],
            "messages": ["query"],
            "key_exprs": list(key_expressions),
            "size_limit": size,
        }

    return [
        rule(
            "small queries",
            JOIN_LIMITS.message_bytes,
            keys.join("*", "*"),
            keys.program("*", "*"),
            keys.snapshots("*"),
            keys.status("*"),
            keys.reports("*", "*"),
            keys.orders("*", "*"),
        ),
        rule("evaluations", EVALUATION_LIMITS.message_bytes, keys.evaluations("*", "*")),
    ]


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
