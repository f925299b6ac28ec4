"""Rates of a run and of its actors between two measurements. State; no I/O."""

import numpy as np

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.fleet import Fleet


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
