"""Metrics rows, status and summary of a run, from its counters and fleet. No I/O."""

from typing import Any

import numpy as np

from daedalus.learner.reporting.metrics import ENV
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.health import Health
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.query_responses import page, totals
from daedalus.protocol.messages import RunStatus
from daedalus.protocol.spec import RunSpec


def episode_statistics(counters: RunCounters) -> dict[str, float]:
    """Return statistics of the newest training episodes; empty before the first episode."""
    if not counters.returns:
        return {}
    returns = np.array(counters.returns)
    return {
        "episode_return_mean": float(returns.mean()),
        "episode_return_std": float(returns.std()),
        "episode_return_min": float(returns.min()),
        "episode_return_max": float(returns.max()),
        "episode_length_mean": float(np.mean(counters.lengths)),
    }


def metrics_row(
    counters: RunCounters,
    fleet: Fleet,
    rates: dict[str, float],
    learning: dict[str, float],
    wall_seconds: float,
) -> dict[str, float]:
    """Return one metrics row, with columns of learner/reporting/metrics.py and the scalars of the environment.

    Args:
      counters: counters of the run.
      fleet: the actors.
      rates: result of `RateMeter.measure`.
      learning: metrics of the updates and of the newest evaluation.
      wall_seconds: duration of the run.
    """
    return {
        "wall_seconds": wall_seconds,
        "env_steps": counters.env_steps,
        "updates": counters.updates,
        "episodes": counters.episodes,
        **episode_statistics(counters),
        **rates,
        "policy_lag_max": counters.policy_lag_max,
        "actors": len(fleet.live),
        "rollouts_accepted": counters.rollouts_accepted,
        "rollouts_rejected": counters.rollouts_rejected.total(),
        "updates_skipped": counters.updates_skipped,
        **learning,
        **{ENV + name: float(np.mean(values)) for name, values in counters.info.items()},
    }


def run_status(
    run: str,
    learner_epoch: int,
    spec: RunSpec,
    counters: RunCounters,
    fleet: Fleet,
    rates: dict[str, float],
    health: Health,
    queue_bytes: int,
    now: float,
) -> RunStatus:
    """Return the status of the run with its first actors. `now` is on the monotonic clock, in seconds."""
    fleet.forget_absent(now)
    return RunStatus(
        run=run,
        learner_epoch=learner_epoch,
        algorithm=spec.training.algorithm,
        environment=spec.environment.id,
        problems=health.problems(now, len(fleet.live)),
        uptime_seconds=now - health.started,
        env_steps=counters.env_steps,
        env_steps_budget=spec.training.env_steps,
        updates=counters.updates,
        updates_skipped=counters.updates_skipped,
        episode_return_mean=counters.episode_return_mean,
        env_steps_per_second=rates.get("env_steps_per_second", 0.0),
        updates_per_second=rates.get("updates_per_second", 0.0),
        policy_lag_mean=rates.get("policy_lag_mean", 0.0),
        queue_bytes=queue_bytes,
        queue_bytes_limit=spec.service.queue_bytes,
        checkpoint_age_seconds=None if health.saved is None else now - health.saved,
        certificate_days_left=health.certificate_days_left(),
        rollouts_accepted=counters.rollouts_accepted,
        rollouts_rejected=dict(counters.rollouts_rejected),
        **totals(fleet),
        refused_joins=fleet.refused_joins.report(now),
        actors=page(fleet, "", now),
    )


def summary(
    run: str,
    spec: RunSpec,
    counters: RunCounters,
    *,
    finished: bool,
    wall_seconds: float,
    env_steps_per_second: float,
) -> dict[str, Any]:
    """Return the content of summary.json at the end of training. A final evaluation adds its results later."""
    return {
        "run": run,
        "algorithm": spec.training.algorithm,
        "environment": spec.environment.id,
        "seed": spec.training.seed,
        "solved": counters.seconds_to_target is not None,
        "finished": finished,
        "env_steps": counters.env_steps,
        "updates": counters.updates,
        "updates_skipped": counters.updates_skipped,
        "episodes": counters.episodes,
        "wall_seconds": wall_seconds,
        "seconds_to_target": counters.seconds_to_target,
        "env_steps_per_second": env_steps_per_second,
        "episode_return_mean": counters.episode_return_mean,
        "evaluation_return_mean": None,
        "evaluation_return_std": None,
        "confirmation_return_mean": None,
        "policy_lag_mean": counters.policy_lag_mean,
        "policy_lag_max": counters.policy_lag_max,
        "rollouts_accepted": counters.rollouts_accepted,
        "rollouts_rejected": dict(counters.rollouts_rejected),
        "rollout_bytes_per_env_step": counters.rollout_bytes / max(counters.accepted_env_steps, 1),
        "snapshots_published": counters.snapshots_published,
    }
