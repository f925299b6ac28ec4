"""What failed during a run: rejections, lost actors, restarts. Pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass

from daedalus.cli.reports.run_record import RunRecord
from daedalus.learner.serving.events import RESTARTED, RESUMED, RecordedEvent

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
