"""What a run tells of itself: metrics rows, the status, the summary. Reads counters and fleet; no I/O."""

from typing import Any

import numpy as np

from learner.counters import RunCounters
from learner.fleet import Fleet
from protocol.spec import RunSpec, RunStatus


class RateMeter:
    """Rates since the last look."""

    def __init__(self, counters: RunCounters, now: float) -> None:
        self.rates: dict[str, float] = {}  # as of the last look
        self._mark(counters, now)

    def _mark(self, counters: RunCounters, now: float) -> None:
        self._then, self._env_steps, self._updates = now, counters.env_steps, counters.updates
        self._rollouts, self._lag = counters.rollouts_trained, counters.policy_lag_sum

    def look(self, counters: RunCounters, now: float) -> dict[str, float]:
        """env_steps and updates a second, and the mean policy lag, since the last look."""
        seconds = max(now - self._then, 1e-9)
        rollouts = max(counters.rollouts_trained - self._rollouts, 1)
        self.rates = {
            "env_steps_per_second": (counters.env_steps - self._env_steps) / seconds,
            "updates_per_second": (counters.updates - self._updates) / seconds,
            "policy_lag_mean": (counters.policy_lag_sum - self._lag) / rollouts,
        }
        self._mark(counters, now)
        return self.rates


def episode_statistics(counters: RunCounters) -> dict[str, float]:
    """How the newest training episodes went; empty before the first."""
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
    """One row of learner/metrics.py; `learning` is what the learner measured."""
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
        **learning,
    }


def run_status(
    run: str,
    learner_epoch: int,
    spec: RunSpec,
    counters: RunCounters,
    fleet: Fleet,
    rates: dict[str, float],
    started: float,
    now: float,
) -> RunStatus:
    """The answer to a status query; `started` and `now` are on the monotonic clock."""
    return RunStatus(
        run=run,
        learner_epoch=learner_epoch,
        algorithm=spec.training.algorithm,
        environment=spec.environment.id,
        uptime_seconds=now - started,
        env_steps=counters.env_steps,
        env_steps_budget=spec.training.env_steps,
        updates=counters.updates,
        episode_return_mean=counters.episode_return_mean,
        env_steps_per_second=rates.get("env_steps_per_second", 0.0),
        updates_per_second=rates.get("updates_per_second", 0.0),
        policy_lag_mean=rates.get("policy_lag_mean", 0.0),
        actors=fleet.statuses(now),
    )


def summary(
    run: str,
    spec: RunSpec,
    counters: RunCounters,
    *,
    solved: bool,
    finished: bool,
    seconds_to_target: float | None,
    wall_seconds: float,
    env_steps_per_second: float,
) -> dict[str, Any]:
    """What summary.json holds when training ends; the evaluation is added by who makes it."""
    return {
        "run": run,
        "algorithm": spec.training.algorithm,
        "environment": spec.environment.id,
        "seed": spec.training.seed,
        "solved": solved,
        "finished": finished,
        "env_steps": counters.env_steps,
        "updates": counters.updates,
        "episodes": counters.episodes,
        "wall_seconds": wall_seconds,
        "seconds_to_target": seconds_to_target,
        "env_steps_per_second": env_steps_per_second,
        "episode_return_mean": counters.episode_return_mean,
        "evaluation_return_mean": None,
        "evaluation_return_std": None,
        "policy_lag_mean": counters.policy_lag_mean,
        "policy_lag_max": counters.policy_lag_max,
        "rollouts_accepted": counters.rollouts_accepted,
        "rollouts_rejected": dict(counters.rollouts_rejected),
        "rollout_bytes_per_env_step": counters.rollout_bytes / max(counters.accepted_env_steps, 1),
        "snapshots_published": counters.snapshots_published,
    }
