"""What a learner tells, in Prometheus' words. Pure functions.

A counter that a learner restored from a checkpoint goes back a little, which Prometheus takes for a restart from 0:
its `rate` then shows a peak of all that was ever counted. So what is drawn as a rate is exported as a gauge too.
"""

from collections.abc import Callable, Iterable, Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from daedalus.protocol.status import ActorStatus, RunStatus

_Family = type[CounterMetricFamily] | type[GaugeMetricFamily]

_OF_A_RUN: tuple[tuple[_Family, str, str, Callable[[RunStatus], float | None]], ...] = (
    (GaugeMetricFamily, "healthy", "1: nothing keeps the service from its work.", lambda run: not run.problems),
    (GaugeMetricFamily, "uptime_seconds", "Age of the learner process.", lambda run: run.uptime_seconds),
    (CounterMetricFamily, "env_steps", "Environment steps trained on.", lambda run: run.env_steps),
    (
        GaugeMetricFamily,
        "env_steps_budget",
        "Environment steps that the run may take.",
        lambda run: run.env_steps_budget,
    ),
    (GaugeMetricFamily, "env_steps_per_second", "Trained on, lately.", lambda run: run.env_steps_per_second),
    (CounterMetricFamily, "updates", "Optimiser steps.", lambda run: run.updates),
    (GaugeMetricFamily, "updates_per_second", "Optimiser steps a second, lately.", lambda run: run.updates_per_second),
    (CounterMetricFamily, "updates_skipped", "Updates without a finite gradient.", lambda run: run.updates_skipped),
    (GaugeMetricFamily, "episode_return_mean", "Of the newest episodes.", lambda run: run.episode_return_mean),
    (GaugeMetricFamily, "policy_lag_updates", "Mean policy lag, lately.", lambda run: run.policy_lag_mean),
    (GaugeMetricFamily, "queue_bytes", "Rollouts that wait to be judged.", lambda run: run.queue_bytes),
    (GaugeMetricFamily, "queue_limit_bytes", "Beyond it actors are told busy.", lambda run: run.queue_bytes_limit),
    (GaugeMetricFamily, "checkpoint_age_seconds", "Of the newest one.", lambda run: run.checkpoint_age_seconds),
)

_OF_AN_ACTOR: tuple[tuple[_Family, str, str, Callable[[ActorStatus], float]], ...] = (
    (CounterMetricFamily, "actor_lives", "Processes that joined under this name.", lambda actor: actor.lives),
    (GaugeMetricFamily, "actor_silence_seconds", "Since it was heard of.", lambda actor: actor.seconds_since_seen),
    (GaugeMetricFamily, "actor_environments", "Environments it plays.", lambda actor: actor.environments),
    (CounterMetricFamily, "actor_env_steps", "Its env_steps trained on.", lambda actor: actor.env_steps),
    (GaugeMetricFamily, "actor_env_steps_per_second", "The same, lately.", lambda actor: actor.env_steps_per_second),
    (CounterMetricFamily, "actor_rollouts_accepted", "Rollouts taken in.", lambda actor: actor.rollouts_accepted),
    (CounterMetricFamily, "actor_rollouts_missed", "Numbered, never came.", lambda actor: actor.rollouts_missed),
    (CounterMetricFamily, "actor_busy_answers", "Told to come again later.", lambda actor: actor.busy_answers),
    (GaugeMetricFamily, "actor_up_bytes_per_second", "Its rollouts.", lambda actor: actor.bytes_up_per_hour / 3600),
    (GaugeMetricFamily, "actor_down_bytes_per_second", "Snapshots.", lambda actor: actor.bytes_down_per_hour / 3600),
    (GaugeMetricFamily, "actor_policy_lag_updates", "Of its newest rollout.", lambda actor: actor.policy_lag),
)


def metrics(statuses: Iterable[RunStatus]) -> Iterator[Metric]:
    """All metrics of all runs that answered: none of them, but for `daedalus_up` 0, if none did.

    Actors that are gone have no series of their own any more; they are counted by their state.
    """
    runs = list({status.run: status for status in statuses}.values())
    yield GaugeMetricFamily("daedalus_up", "1: a learner answers.", value=bool(runs))
    info = GaugeMetricFamily(
        "daedalus_run_info", "What is learned, and how.", labels=["run", "environment", "algorithm"]
    )
    actors = GaugeMetricFamily("daedalus_actors", "Actors by state.", labels=["run", "state"])
    rejected = CounterMetricFamily("daedalus_rollouts_rejected", "Rollouts by cause.", labels=["run", "cause"])
    for run in runs:
        info.add_metric([run.run, run.environment, run.algorithm], 1)
        states = [_state(actor) for actor in run.actors]
        for state in ("alive", "quarantined", "gone"):
            actors.add_metric([run.run, state], states.count(state))
        for cause, count in sorted(run.rollouts_rejected.items()):
            rejected.add_metric([run.run, cause], count)
    yield from (info, actors, rejected)
    for kind, name, text, value_of in _OF_A_RUN:
        family = kind(f"daedalus_{name}", text, labels=["run"])
        for run in runs:
            if (value := value_of(run)) is not None:
                family.add_metric([run.run], value)
        yield family
    for kind, name, text, value_of in _OF_AN_ACTOR:
        family = kind(f"daedalus_{name}", text, labels=["run", "actor"])
        for run in runs:
            for actor in run.actors:
                if actor.alive:
                    family.add_metric([run.run, actor.actor], value_of(actor))
        yield family


def _state(actor: ActorStatus) -> str:
    return "gone" if not actor.alive else "quarantined" if actor.quarantined else "alive"
