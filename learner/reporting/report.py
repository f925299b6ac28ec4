"""Metrics rows, status and summary of a run, from its counters and fleet. No I/O."""

from typing import Any

import numpy as np

from daedalus.learner.reporting.metrics import ENV
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.health import Health
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.fleet_status import page, totals
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.status import RunStatus

# env_steps in each environment without the end of an episode after which a hint is given; the least in a small budget.
_LONG_EPISODE, _USUAL_EPISODE = 10_000, 2_000


class RateMeter:
    """Rates since the last measurement."""

    def __init__(self, counters: RunCounters, now: float) -> None:
        self.rates: dict[str, float] = {}  # of the last measurement
        self._actors: dict[str, tuple[int, int, int]] = {}  # env_steps, received bytes, answered bytes
        self._pushed_bytes = 0
        self._begun, self._first_env_steps, self._first_rollouts = now, counters.env_steps, counters.rollouts_trained
        self._mark(counters, now)

    def overall(self, counters: RunCounters, now: float) -> float:
        """Return env_steps per second since construction."""
        return (counters.env_steps - self._first_env_steps) / max(now - self._begun, 1e-9)

    def _mark(self, counters: RunCounters, now: float) -> None:
        self._then, self._env_steps, self._updates = now, counters.env_steps, counters.updates
        self._rollouts, self._lag = counters.rollouts_trained, counters.policy_lag_sum

    def measure(self, counters: RunCounters, fleet: Fleet, now: float, *, last: bool = False) -> dict[str, float]:
        """Return env_steps and updates per second and the mean policy lag, since the last measurement.

        What is unknown is absent: all of it before the first batch, and the policy lag of no batch. The `last` interval
        of a run ends at any moment: without a batch in it, nothing is known. Also sets the rates of each actor in
        `fleet`. `now` is on the monotonic clock, in seconds.
        """
        seconds = max(now - self._then, 1e-9)
        pushed, self._pushed_bytes = fleet.pushed_bytes - self._pushed_bytes, fleet.pushed_bytes
        for actor in fleet.actors.values():
            totals = actor.env_steps, actor.received_bytes, actor.answered_bytes
            env_steps, received, answered = np.subtract(totals, self._actors.get(actor.name, (0, 0, 0))) / seconds
            self._actors[actor.name] = totals
            subscribed = 0.0 if actor.fetches or not fleet.is_live(actor) else pushed / seconds
            actor.env_steps_per_second = float(env_steps)
            actor.bytes_up_per_hour = 3600 * float(received)
            actor.bytes_down_per_hour = 3600 * float(answered + subscribed)
        self._actors = {name: self._actors[name] for name in fleet.actors}  # without evicted actors
        rollouts = counters.rollouts_trained - self._rollouts
        self.rates = {}
        if rollouts or (counters.rollouts_trained > self._first_rollouts and not last):
            self.rates["env_steps_per_second"] = (counters.env_steps - self._env_steps) / seconds
            self.rates["updates_per_second"] = (counters.updates - self._updates) / seconds
        if rollouts:
            self.rates["policy_lag_mean"] = (counters.policy_lag_sum - self._lag) / rollouts
        self._mark(counters, now)
        return self.rates


class EpisodeHint:
    """Hint that no episode has ended after many steps, or after half of a small budget; given once."""

    def __init__(self, budget: int) -> None:
        """`budget` is in env_steps."""
        self._budget, self._given = budget, False

    def take(self, counters: RunCounters, fleet: Fleet) -> str:
        """Return the hint if it is due, else an empty string."""
        environments = max(sum(fleet.actors[name].environments for name in fleet.live), 1)
        length = min(_LONG_EPISODE, max(_USUAL_EPISODE, self._budget // (2 * environments)))
        if self._given or counters.episodes or counters.env_steps < environments * length:
            return ""
        self._given = True
        return (
            f"no episode has ended after {length:,} env_steps in each environment: "
            "if the environment never ends them, set environment.max_episode_steps"
        )


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
