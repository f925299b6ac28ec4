"""The state of a run and of its actors, as the learner reports it."""

from daedalus.protocol.specification import Specification


class ActorStatus(Specification):
    """One actor as the learner sees it."""

    actor: str
    alive: bool
    quarantined: str  # why nothing is taken from it any more; empty if it is not
    lives: int  # incarnations that joined
    seconds_since_seen: float
    environments: int
    env_steps: int  # trained on
    env_steps_per_second: float
    rollouts_accepted: int
    rollouts_rejected: dict[str, int]  # by cause
    rollouts_missed: int  # sequence numbers that never came
    busy_answers: int  # how often it was told to come again later
    policy_lag: int  # of its newest rollout
    compact_snapshots: bool  # it asks for snapshots that fit its link; to all others every one is pushed
    bytes_up_per_hour: float  # rollouts, at the rate of the last seconds
    bytes_down_per_hour: float  # snapshots


class RunStatus(Specification):
    """The fleet as the learner sees it; the answer to a `status` query."""

    run: str
    learner_epoch: int
    algorithm: str
    environment: str
    problems: tuple[str, ...]  # what keeps the service from doing its work; healthy if there are none
    uptime_seconds: float  # of this life
    env_steps: int
    env_steps_budget: int
    updates: int
    updates_skipped: int  # of them, those whose gradient was not finite: they changed nothing
    episode_return_mean: float | None
    env_steps_per_second: float
    updates_per_second: float
    policy_lag_mean: float
    queue_bytes: int  # rollouts that wait to be judged
    queue_bytes_limit: int
    checkpoint_age_seconds: float | None  # None before the first of this life
    rollouts_rejected: dict[str, int]  # by cause, also from senders that never joined
    actors: tuple[ActorStatus, ...]
