"""Rates of a run and of its actors, over windows that follow how often their counts grow. No I/O."""

from collections import deque
from dataclasses import dataclass

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.actor_state import Actor
from daedalus.learner.serving.fleet import Fleet

_WINDOW_SECONDS, _WINDOW_GROWTHS = 10.0, 4  # of a rate: the longer of the two
_SPACING_SECONDS = 1.0  # between the moments at which a window may begin


class Rate:
    """Rate of a count: over the last 10 s, or over its last four growths if they took longer.

    A slow simulator's count grows in few of the measurements. Between two growths the rate stays; once the next growth
    is later than usual, the rate falls as if it came now.
    """

    def __init__(self, now: float, count: float) -> None:
        """`now` is on the monotonic clock, in seconds."""
        self._count, self._grown, self._growths = count, now, 0  # the newest count, since when, and how often it grew
        self._begins = deque([(now, count, 0)])  # of possible windows: times, counts and growths, the oldest first

    def add(self, now: float, count: float) -> float:
        """Take the count at a time; return its rate per second."""
        if count > self._count:
            self._count, self._grown, self._growths = count, now, self._growths + 1
            if now - self._begins[-1][0] >= _SPACING_SECONDS:
                self._begins.append((now, count, self._growths))
        while len(self._begins) > 1:
            began, _, growths = self._begins[1]
            if now - began < _WINDOW_SECONDS or self._growths - growths < _WINDOW_GROWTHS:
                break
            self._begins.popleft()
        began, before, growths = self._begins[0]
        growths = self._growths - growths
        seconds = max(self._grown - began, (now - began) * growths / (growths + 1))
        return (self._count - before) / max(seconds, 1e-9)


class _ActorRates:
    """Rates of one actor."""

    def __init__(self, actor: Actor, now: float) -> None:
        self.actor = actor
        self._env_steps, self._up, self._down = (Rate(now, 0) for _ in range(3))
        self._pushed = 0  # bytes so far

    def measure(self, now: float, *, is_live: bool, pushed: int) -> None:
        """Set the rates of the actor, to which so many bytes were pushed if it subscribes."""
        actor = self.actor
        self._pushed += 0 if actor.fetches or not is_live else pushed
        env_steps = self._env_steps.add(now, actor.env_steps)
        up = self._up.add(now, actor.received_bytes)
        down = self._down.add(now, actor.answered_bytes + self._pushed)
        actor.env_steps_per_second = env_steps if is_live else 0.0
        actor.bytes_up_per_hour = 3600 * up if is_live else 0.0
        actor.bytes_down_per_hour = 3600 * down if is_live else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRates:
    """Newest rates of a run; all 0 before the first batch."""

    env_steps_per_second: float = 0.0
    updates_per_second: float = 0.0
    policy_lag_mean: float = 0.0  # of the newest batches, in updates
    learning_share: float = 0.0  # of the time in which the learner computes updates
    decoding_share: float = 0.0  # of the time in which the learner decodes rollouts


class RateMeter:
    """Measures the rates of a run and of its actors."""

    def __init__(self, counters: RunCounters, now: float) -> None:
        """`now` is on the monotonic clock, in seconds."""
        self.rates = RunRates()  # of the last measurement
        self._begun, self._first_env_steps, self._first_rollouts = now, counters.env_steps, counters.rollouts_trained
        self._then, self._rollouts, self._lag = now, counters.rollouts_trained, counters.policy_lag_sum
        self._env_steps, self._updates = Rate(now, counters.env_steps), Rate(now, counters.updates)
        self._learning, self._decoding = Rate(now, counters.learning_seconds), Rate(now, counters.decoding_seconds)
        self._actors: dict[str, _ActorRates] = {}
        self._pushed_bytes = 0

    def overall(self, counters: RunCounters, now: float) -> float:
        """Return env_steps per second since construction."""
        return (counters.env_steps - self._first_env_steps) / max(now - self._begun, 1e-9)

    def measure(
        self, counters: RunCounters, fleet: Fleet, now: float, *, last: bool = False, is_stalled: bool = False
    ) -> dict[str, float]:
        """Return env_steps and updates per second, and the mean policy lag since the last measurement, for a row.

        What is unknown is absent: all of it before the first batch, and the policy lag of no batch. The `last` interval
        of a run ends at any moment: without a batch in it, nothing is known. Also sets `rates`, and the rates of each
        actor in `fleet`.

        Args:
          counters, fleet: those of the run.
          now: time on the monotonic clock, in seconds.
          last: whether the run ends here.
          is_stalled: whether no update comes any more: the rates are 0.
        """
        self._measure_actors(fleet, now)
        rollouts = counters.rollouts_trained - self._rollouts
        lag = (counters.policy_lag_sum - self._lag) / rollouts if rollouts else self.rates.policy_lag_mean
        self._rollouts, self._lag = counters.rollouts_trained, counters.policy_lag_sum
        runs = 0.0 if is_stalled else 1.0
        self.rates = RunRates(
            env_steps_per_second=runs * self._env_steps.add(now, counters.env_steps),
            updates_per_second=runs * self._updates.add(now, counters.updates),
            policy_lag_mean=lag,
            learning_share=runs * min(self._learning.add(now, counters.learning_seconds), 1.0),
            decoding_share=runs * min(self._decoding.add(now, counters.decoding_seconds), 1.0),
        )
        row = {}
        if rollouts or (counters.rollouts_trained > self._first_rollouts and not last):
            row["env_steps_per_second"] = self.rates.env_steps_per_second
            row["updates_per_second"] = self.rates.updates_per_second
        if rollouts:
            row["policy_lag_mean"] = lag
        return row

    def _measure_actors(self, fleet: Fleet, now: float) -> None:
        pushed, self._pushed_bytes = fleet.pushed_bytes - self._pushed_bytes, fleet.pushed_bytes
        known, self._actors = self._actors, {}  # without forgotten actors
        for name, actor in fleet.actors.items():
            rates = known.get(name)
            if rates is None or rates.actor is not actor:  # another one has joined under the name of a forgotten one
                rates = _ActorRates(actor, self._then)
            self._actors[name] = rates
            rates.measure(now, is_live=fleet.is_live(actor), pushed=pushed)
        self._then = now
