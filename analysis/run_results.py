"""Results of one run, as a report and a model card show them: its evaluation, and what failed. Pure functions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daedalus.analysis.comparison import Estimate
from daedalus.analysis.recorded_run import RecordedEvaluation, RunRecord
from daedalus.analysis.statistics import interquartile_mean, stratified_bootstrap
from daedalus.learner.serving.events import RESTARTED, RESUMED, RecordedEvent
from daedalus.learner.target_confirmation import mean_interval
from daedalus.protocol.texts import short_number

_REPETITIONS = 2000
_MOST_VALUES = 4_000_000  # that the bootstrap draws in all, to limit its memory and its time


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeStatistics:
    """Statistics of the returns of one policy's episodes. The intervals are of 95 % and are about this policy alone."""

    mean: Estimate  # NaN: unknown, as for a single episode
    std: float
    interquartile: Estimate | None  # None without the returns of the episodes, as the median
    median: float | None


def episode_statistics(evaluation: RecordedEvaluation) -> EpisodeStatistics:
    """Return the statistics of an evaluation."""
    interval = mean_interval(evaluation.return_mean, evaluation.return_std, evaluation.episodes)
    returns = np.array(evaluation.returns)
    return EpisodeStatistics(
        mean=Estimate(evaluation.return_mean, *(interval or (math.nan, math.nan))),
        std=evaluation.return_std,
        interquartile=_interquartile(returns) if len(returns) else None,
        median=float(np.median(returns)) if len(returns) else None,
    )


def _interquartile(returns: np.ndarray) -> Estimate:
    """Return the interquartile mean of returns, [episodes], with its bootstrap interval."""
    value = float(interquartile_mean(returns))
    repetitions = min(_MOST_VALUES // len(returns), _REPETITIONS)
    if repetitions < _REPETITIONS // 10:
        return Estimate(value, math.nan, math.nan)
    low, high = stratified_bootstrap([returns], lambda samples: interquartile_mean(samples[0]), repetitions=repetitions)
    return Estimate(value, float(low), float(high))


_FAILED = {"left", "refused", "failed", "rejected", "quarantined", RESTARTED}
_NO_FAILURES = ("checkpoint saved", RESUMED)  # begin of the texts of checkpoints that did not fail


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureCount:
    """A kind of failure, and how often it happened."""

    name: str
    count: int
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RepeatedEvent:
    """Equal events, as one."""

    first: RecordedEvent
    last: str  # time of the last one
    count: int


def failed_events(events: Sequence[RecordedEvent]) -> list[RecordedEvent]:
    """Return the events that are failures. Actors that leave after the end of the run are none."""
    failed = []
    started = ended = False
    for event in events:
        if event.kind == "started":
            if started:
                failed.append(event)
            started, ended = True, False
        elif event.kind == "ended":
            ended = True
        elif event.kind == "left":
            failed += [] if ended else [event]
        elif event.kind in _FAILED or (event.kind == "checkpoint" and not event.text.startswith(_NO_FAILURES)):
            failed.append(event)
    return failed


def together(events: Sequence[RecordedEvent]) -> list[RepeatedEvent]:
    """Return equal events as one each, in the order of the first."""
    found: dict[tuple[str, str, str], RepeatedEvent] = {}
    for event in events:
        key = event.kind, event.actor, event.text
        before = found.get(key)
        count = event.count + (before.count if before else 0)
        found[key] = RepeatedEvent(first=before.first if before else event, last=event.time, count=count)
    return list(found.values())


def failure_counts(record: RunRecord) -> list[FailureCount]:
    """Return how often each kind of failure happened, without those that did not happen."""
    failed = failed_events(record.events)

    def of(*kinds: str) -> int:
        return sum(event.count for event in failed if event.kind in kinds)

    # The counters of a learner that was killed are lost since its last checkpoint, and events are limited.
    rejected = max(int(record.number("rollouts_rejected") or 0), sum(record.rejected.values()), of("rejected"))
    causes = ", ".join(f"{cause} {count:,}" for cause, count in sorted(record.rejected.items()))
    counts = [
        FailureCount(
            name="learner started again", count=of("started"), detail="after a failure, or by daedalus resume"
        ),
        FailureCount(name="process restarted by the launcher", count=of(RESTARTED)),
        FailureCount(name="actor lost or gone", count=of("left"), detail="before the end of the run"),
        FailureCount(name="actor refused or failed", count=of("refused", "failed")),
        FailureCount(name="actor quarantined", count=of("quarantined")),
        FailureCount(name="rollout rejected", count=rejected, detail=_share(record, rejected, causes)),
        FailureCount(
            name="update skipped", count=int(record.number("updates_skipped") or 0), detail="gradient not finite"
        ),
        FailureCount(name="checkpoint not saved", count=of("checkpoint")),
    ]
    return [each for each in counts if each.count > 0]


def _share(record: RunRecord, rejected: int, causes: str) -> str:
    accepted = record.number("rollouts_accepted")
    if not rejected or accepted is None:
        return causes
    share = f"{100 * rejected / (rejected + accepted):.2g} % of all"
    return f"{share}: {causes}" if causes else share


def statistics_rows(evaluation: RecordedEvaluation, statistics: EpisodeStatistics) -> list[tuple[str, str]]:
    """Return the statistics of an evaluation as names and values."""
    mean, rows = statistics.mean, list[tuple[str, str]]()
    if evaluation.matches is not None:
        total, (low, high) = evaluation.matches.total, evaluation.matches.total.win_interval
        won = f"{total.wins:,} of {total.games:,}, drawn {total.draws:,}, lost {total.losses:,}"
        rows += [
            (f"games won against {evaluation.matches.opponent}", won),
            ("95 % interval of the share of wins", f"{low:.1%} to {high:.1%}"),
        ]
    rows += [
        ("mean", written(mean.value)),
        ("95 % interval of the mean", interval_text(mean.low, mean.high)),
        ("standard deviation", written(statistics.std)),
    ]
    if statistics.interquartile is not None:
        middle = statistics.interquartile
        rows += [
            ("interquartile mean", written(middle.value)),
            ("95 % bootstrap interval", interval_text(middle.low, middle.high)),
            ("median", written(statistics.median)),
        ]
    rows += [
        ("lowest and highest", interval_text(evaluation.return_min, evaluation.return_max)),
        ("mean length (env_steps)", written(evaluation.length_mean)),
    ]
    return rows


def interval_text(low: float, high: float) -> str:
    """Return the ends of an interval as a text; `-` if they are unknown."""
    return "-" if low != low or high != high else f"{written(low)} to {written(high)}"


def written(value: float | None) -> str:
    """Return a number for a text or a table cell, whole ones without a point; `-` for None and NaN."""
    if value is None or math.isnan(value):
        return "-"
    whole = 10 <= abs(value) < 1e15 and float(value).is_integer()
    return f"{value:,.0f}" if whole else short_number(value)
