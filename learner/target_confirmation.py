"""Confirmation of a target that was reached: the learner waits while an evaluator plays new episodes.

It waits as well for those of a policy that has imitated demonstrations, before it goes on to train it.

The mean of the newest training episodes reaches the target more probably in a lucky moment, and while they were played
the policy changed. So their mean is too high on average, and the policy of that moment may be worse than those before.
New sampled episodes with that policy show what it can do.

The evaluator is a process of this host: learner/serving/evaluator_host.py.
"""

import logging
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Literal

from daedalus.learner.serving.evaluator_host import EpisodePlan, EvaluatorError, EvaluatorHost, OfferedPolicy
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.protocol.messages import EvaluationReport
from daedalus.protocol.texts import exact_number, short_number
from daedalus.transport.interface import Transport, TransportError

if TYPE_CHECKING:
    from daedalus.learner.training.checkpointer import Checkpointer
    from daedalus.learner.training.learner import Learner

_CONFIDENCE = 0.95  # share of cases that an interval is to contain
# Added to the seed of the run: no other evaluation of the run and no training uses these seeds.
_SEEDS, _CLONED_SEEDS = 2**34, 2**35

_logger = logging.getLogger(__name__)


def confirmation(result: dict[str, Any], target: float) -> dict[str, Any]:
    """Return the result of new episodes with two more entries.

    `interval` is the 95 % interval of the mean (None of one episode). `confirmed`: the mean itself reaches the target.
    So a policy whose true mean is the target is confirmed in half of the attempts, one that is one standard error below
    it in 16 of 100, and two in 2 of 100. The upper end of the interval would accept them in 98, 84 and 49 of 100.
    """
    interval = mean_interval(result["return_mean"], result["return_std"], result["episodes"])
    return {**result, "interval": interval, "confirmed": result["return_mean"] >= target}


def mean_interval(mean: float, std: float, count: int) -> tuple[float, float] | None:
    """Return the 95 % interval of a mean over `count` values, or None for a single value.

        mean +- t s / sqrt(n),  s^2 = n / (n - 1) std^2

    with the 97.5 % quantile t of Student's distribution, n - 1 degrees of freedom.

    Args:
      mean, std: of the values; std is that of the values themselves, with n in the denominator.
    """
    if count < 2:
        return None
    error = _t_quantile(count - 1) * std / math.sqrt(count - 1)
    return mean - error, mean + error


def _t_quantile(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t, to eight digits.

    Up to 200 degrees of freedom that of the exact distribution, Abramowitz & Stegun (1964), equations 26.7.3 and
    26.7.4; beyond, where its series is exact to ten digits, equation 26.7.5.
    """
    if freedom <= 200:
        low, high = 0.0, math.pi / 2
        while (angle := (low + high) / 2) not in (low, high):
            low, high = (angle, high) if _t_within(angle, freedom) < _CONFIDENCE else (low, angle)
        return math.sqrt(freedom) * math.tan(high)
    z = NormalDist().inv_cdf((1.0 + _CONFIDENCE) / 2)
    terms = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
    )
    return sum(term / freedom**power for power, term in enumerate(terms))


def _t_within(angle: float, freedom: int) -> float:
    """Return the probability that |t| is at most sqrt(freedom) tan(angle)."""
    odd = freedom % 2
    term, total = (math.cos(angle), 0.0) if odd else (1.0, 0.0)
    for power in range(odd, freedom - 1, 2):
        total += term
        term *= math.cos(angle) ** 2 * (power + 1) / (power + 2)
    if odd:
        return 2 / math.pi * (angle + math.sin(angle) * total)
    return math.sin(angle) * total


@dataclass(frozen=True, slots=True)
class Player:
    """An evaluator that reaches `transport`, as nobody else does."""

    transport: Transport
    failure: Callable[[], str]  # why it has failed for good; empty as long as it may still play


class TargetConfirmation:
    """The new episodes of one run."""

    def __init__(
        self,
        context: RunContext,
        publisher: SnapshotPublisher,
        open_player: Callable[[], AbstractContextManager[Player]],
        beat: Callable[[], None],
    ) -> None:
        """Construct the confirmation.

        Args:
          context: the run; its newest returns are forgotten when the target is not confirmed.
          publisher: has the program of the policy.
          open_player: starts a player, and ends it. Raises TransportError or OSError.
          beat: called again and again during the wait, to show that this process works.
        """
        self._context, self._publisher, self._open_player, self._beat = context, publisher, open_player, beat
        self._not_before = -math.inf  # of the next attempt, on the monotonic clock
        self.result: dict[str, Any] | None = None  # of the new episodes that confirmed the target

    def confirm(self, learner: "Learner", checkpointer: "Checkpointer") -> bool:
        """Wait until new episodes are played with the present policy, and return whether they confirm the target.

        If they do not, the newest returns are forgotten: the target has to be reached again, and training goes on for
        at least as long as the attempt has lasted: attempts take at most half of the time. Until then, nothing is
        played. If the episodes cannot be played, or nothing can be written to the disk, the target counts as reached
        without them.
        """
        began = time.monotonic()
        if began < self._not_before:
            return False
        saving = checkpointer.begin()  # a learner that is killed meanwhile continues from it, and asks again
        if not checkpointer.wait(saving, self._beat, patient=False):
            return not self._context.stop.is_set()  # when a stopped run is resumed, it asks again
        training, version = self._context.spec.training, learner.policy_version
        episodes = f"{training.target_episodes} new episodes"
        target = exact_number(training.target_return)
        text = f"target {target} reached: the policy of this moment plays {episodes} to confirm it"
        self._context.events.add("target", text, cause=f"version {version}")
        try:
            played = self._played_with(learner, training.target_episodes, _SEEDS, "sampled")
        except (EvaluatorError, TransportError, OSError) as error:  # of some simulators only one can run
            text = f"the target cannot be confirmed: {error}"
            self._context.events.add("target", text, cause=f"result of version {version}")
            return True
        if played is None:  # the run is stopped; when it is resumed, it asks again
            return False
        assert training.target_return is not None
        plan, report = played
        result = confirmation(plan.result(saving.directory, report), training.target_return)
        if result["confirmed"]:
            self.result = result
            return True
        with self._context.lock:
            self._context.counters.forget_returns()
        ended = time.monotonic()
        self._not_before = ended + (ended - began)
        text = (
            f"not there yet: the new episodes have a mean return of {short_number(result['return_mean'])}. That is "
            "normal: the first mean that reaches a target is often a lucky one. Training goes on, and tries again"
        )
        self._context.events.add("target", text, cause=f"result of version {version}")
        return False

    def evaluate_cloned(self, learner: "Learner") -> None:
        """Wait until the policy that has imitated demonstrations is evaluated: the first evaluation of the run."""
        evaluation = self._context.spec.evaluation
        try:
            played = self._played_with(learner, evaluation.episodes, _CLONED_SEEDS, evaluation.actions)
        except (EvaluatorError, TransportError, OSError) as error:
            _logger.warning("the policy after behaviour cloning cannot be evaluated: %s", error)
        else:
            if played is not None:
                result = self._context.evaluations.note(played[1], 0)
                _logger.info("after behaviour cloning: return %s, %s", result, evaluation.actions)

    def _played_with(
        self, learner: "Learner", episodes: int, seeds: int, actions: Literal["greedy", "sampled"]
    ) -> tuple[EpisodePlan, EvaluationReport] | None:
        """Return the episodes, or None if the run is stopped first.

        Raises EvaluatorError, and as `open_player`.
        """
        context, program = self._context, self._publisher.offered
        spec, spaces = context.spec, context.fleet.spaces
        assert program is not None
        assert spaces is not None
        plan = EpisodePlan(
            spec=spec,
            environment=spec.environment.as_evaluated(),
            spaces=spaces,
            episodes=episodes,
            seed=spec.training.seed + seeds,
            actions=actions,
        )
        policy = OfferedPolicy(policy_version=learner.policy_version, program=program, weights=learner.weights())
        with self._open_player() as player:

            def goes_on() -> bool:
                if failure := player.failure():
                    raise EvaluatorError(failure)
                self._beat()
                health = context.health
                health.updated = health.awaited_since = time.monotonic()  # it works, although it does not train
                return not context.stop.is_set()

            reports = EvaluatorHost(context.name, player.transport).play(plan, [policy], goes_on)
        return None if reports is None else (plan, reports[0])
