"""State of a run and of its actors, as the learner reports it."""

from typing import Literal

from daedalus.protocol.specification import Specification

MAX_EVENTS = 100  # that a learner keeps
PAGE_ACTORS = 64  # in one answer, so that it stays within the reader's limits whatever the size of the fleet


class ActorStatus(Specification):
    """State of one actor."""

    actor: str
    host: str  # where it runs, what it runs and its address, as the actor states them
    software: str
    address: str
    alive: bool
    quarantined: str  # why its rollouts are no longer accepted; empty if they are
    lives: int  # incarnations that joined
    seconds_since_seen: float
    environments: int
    epsilon: float  # the probability with which it takes a random action in the end; 0: it does not explore
    env_steps: int  # that were trained on
    env_steps_per_second: float
    rollouts_accepted: int
    rollouts_rejected: dict[str, int]  # by cause
    rollouts_missed: int  # sequence numbers that never arrived
    busy_answers: int  # how often the learner answered busy
    policy_lag: int  # of its newest rollout, in updates
    compact_snapshots: bool  # it requests compact snapshots, not whole ones
    bytes_up_per_hour: float  # of rollouts, at the rate of the last seconds
    bytes_down_per_hour: float  # of snapshots
    # What a client reports of its newest process (protocol/client_report.py); 0 and empty for any other actor.
    deadlines: int = 0
    missed_deadlines: int = 0
    overridden_actions: int = 0
    safe_actions: int = 0
    rollouts_dropped: int = 0
    safe_reason: str = ""


class RefusedJoin(Specification):
    """Joins that were refused for the same reason, and failures that actors of one host reported."""

    actor: str  # that was refused last
    host: str  # as the actor states it; empty if it is not known
    software: str  # likewise, or the protocol version if it is not this learner's
    reason: str
    count: int
    seconds_since_last: float


EventKind = Literal[
    "started", "joined", "left", "refused", "failed", "rejected", "quarantined", "target", "checkpoint", "ended"
]


class Event(Specification):
    """One event of a run, or several equal ones within a minute."""

    time: str  # of the first, by the learner's clock: ISO 8601, UTC
    kind: EventKind
    actor: str  # that the event is about; empty if it is about the run
    text: str
    count: int


class EventsPage(Specification):
    """The newest events of one learner process (MAX_EVENTS), the newest last."""

    run: str
    learner_epoch: int
    events: tuple[Event, ...]


class ActorsPage(Specification):
    """Part of the list of all actors, sorted by name."""

    learner_epoch: int
    actors: tuple[ActorStatus, ...]


class RunStatus(Specification):
    """State of a run and its actors. The answer to a `status` query has the first actors only (PAGE_ACTORS)."""

    run: str
    learner_epoch: int
    algorithm: str
    environment: str
    problems: tuple[str, ...]  # reasons why the service is not healthy; empty if it is
    uptime_seconds: float  # of this learner process
    env_steps: int
    env_steps_budget: int
    updates: int
    updates_skipped: int  # number of updates skipped because the gradient was not finite
    episode_return_mean: float | None
    env_steps_per_second: float
    updates_per_second: float
    policy_lag_mean: float
    queue_bytes: int  # of rollouts that wait to be decoded
    queue_bytes_limit: int
    checkpoint_age_seconds: float | None  # None before the first checkpoint of this process
    certificate_days_left: float | None  # of the learner's certificate; None without one
    rollouts_accepted: int
    rollouts_rejected: dict[str, int]  # by cause, including senders that never joined
    rollouts_missed: int  # sequence numbers that never arrived
    busy_answers: int  # how often the learner answered busy
    actors_alive: int
    actors_quarantined: int  # present, but their rollouts are no longer accepted
    actors_gone: int  # absent for less than a minute; later they are forgotten, and only the totals above include them
    refused_joins: tuple[RefusedJoin, ...]  # of the last hour, the newest last
    actors: tuple[ActorStatus, ...]  # sorted by name

    @property
    def fleet_size(self) -> int:
        """Number of actors of the run, on whatever page they are."""
        return self.actors_alive + self.actors_quarantined + self.actors_gone
