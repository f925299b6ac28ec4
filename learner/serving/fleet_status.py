"""State of the fleet as the status reports it: totals, and one page of actors at a time. Pure functions."""

import heapq
from typing import TypedDict

from daedalus.learner.serving.fleet import Actor, Fleet
from daedalus.protocol.messages import PAGE_ACTORS, ActorStatus, ClientReport


class FleetTotals(TypedDict):
    """Fields of RunStatus that are over all actors. The counts include forgotten actors."""

    actors_alive: int
    actors_quarantined: int
    actors_gone: int
    rollouts_missed: int
    busy_answers: int


def totals(fleet: Fleet) -> FleetTotals:
    """Return the totals over all actors."""
    actors = fleet.actors.values()
    present = [actor for actor in actors if fleet.is_present(actor)]
    quarantined = sum(bool(actor.quarantined) for actor in present)
    return {
        "actors_alive": len(present) - quarantined,
        "actors_quarantined": quarantined,
        "actors_gone": len(actors) - len(present),
        "rollouts_missed": min(fleet.forgotten_missed + sum(actor.missed for actor in actors), 2**53),
        "busy_answers": fleet.forgotten_busy + sum(actor.busy for actor in actors),
    }


def page(fleet: Fleet, after: str, now: float) -> tuple[ActorStatus, ...]:
    """Return the status of the actors with the first names after `after`, sorted by name.

    `now` is on the monotonic clock, in seconds.
    """
    names = heapq.nsmallest(PAGE_ACTORS, (name for name in fleet.actors if name > after))
    return tuple(_actor_status(fleet, fleet.actors[name], now) for name in names)


def _actor_status(fleet: Fleet, actor: Actor, now: float) -> ActorStatus:
    client = actor.client or ClientReport(actor=actor.name, incarnation=actor.incarnation)
    return ActorStatus(
        actor=actor.name,
        host=actor.origin.host,
        software=actor.origin.software,
        address=actor.origin.address,
        alive=fleet.is_present(actor),
        quarantined=actor.quarantined,
        lives=actor.incarnations,
        seconds_since_seen=max(now - actor.last_seen, 0.0),
        environments=actor.environments,
        epsilon=actor.epsilon,
        env_steps=actor.env_steps,
        env_steps_per_second=actor.env_steps_per_second,
        rollouts_accepted=actor.accepted,
        rollouts_rejected=dict(actor.rejected),
        rollouts_missed=actor.missed,
        busy_answers=actor.busy,
        policy_lag=actor.policy_lag,
        compact_snapshots=actor.compact_snapshots,
        bytes_up_per_hour=actor.bytes_up_per_hour,
        bytes_down_per_hour=actor.bytes_down_per_hour,
        deadlines=client.deadlines,
        missed_deadlines=client.missed_deadlines,
        overridden_actions=client.overridden_actions,
        safe_actions=client.safe_actions,
        rollouts_dropped=client.rollouts_dropped,
        safe_reason=client.safe_reason,
    )
