"""Examples of the status that a learner sends."""

from collections.abc import Sequence
from typing import Any

from daedalus.protocol.messages import ActorStatus, RunStatus


def actor_status(name: str, **changes: Any) -> ActorStatus:
    values = {
        "actor": name,
        "host": "gpu-box",
        "software": "daedalus-rl 1.0",
        "address": "tcp/10.0.0.7:43092",
        "alive": True,
        "quarantined": "",
        "lives": 1,
        "seconds_since_seen": 0.5,
        "environments": 4,
        "epsilon": 0.0,
        "env_steps": 50,
        "env_steps_per_second": 10.0,
        "rollouts_accepted": 5,
        "rollouts_rejected": {"stale": 1},
        "rollouts_missed": 0,
        "busy_answers": 0,
        "policy_lag": 1,
        "compact_snapshots": False,
        "bytes_up_per_hour": 7200.0,
        "bytes_down_per_hour": 3600.0,
    }
    return ActorStatus(**{**values, **changes})


def run_status(actors: Sequence[ActorStatus] = (), **changes: Any) -> RunStatus:
    values = {
        "run": "mine",
        "learner_epoch": 1,
        "algorithm": "impala",
        "environment": "CartPole-v1",
        "problems": (),
        "uptime_seconds": 12.0,
        "env_steps": 100,
        "env_steps_budget": 1000,
        "updates": 7,
        "updates_skipped": 0,
        "episode_return_mean": 20.0,
        "env_steps_per_second": 20.0,
        "updates_per_second": 1.5,
        "policy_lag_mean": 1.0,
        "queue_bytes": 0,
        "queue_bytes_limit": 1024,
        "checkpoint_age_seconds": 3.0,
        "certificate_days_left": None,
        "rollouts_accepted": 30,
        "rollouts_rejected": {"stale": 2},
        "rollouts_missed": 4,
        "busy_answers": 5,
        "refused_joins": (),
        "actors": actors,
        "software": "daedalus-rl 1.0",
    }
    return RunStatus(**{**values, **_counts(actors), **changes})


def _counts(actors: Sequence[ActorStatus]) -> dict[str, int]:
    """Return the number of actors in each state."""
    present = [actor for actor in actors if actor.alive]
    quarantined = sum(bool(actor.quarantined) for actor in present)
    return {
        "actors_alive": len(present) - quarantined,
        "actors_quarantined": quarantined,
        "actors_gone": len(actors) - len(present),
    }
