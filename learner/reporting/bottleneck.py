"""What a run waits for, in one line: its learner, its actors, one of them, or what is between them. Pure functions.

The learner measures the shares of its time in which it computes updates and decodes rollouts (rates.py). Each actor
measures how long a rollout takes it, and how long it then waits (ClientReport). An actor waits for the learner at most
while that works. So what is left of the time, without a working learner or a playing actor, goes to what is under way.
"""

from collections.abc import Iterable, Sequence
from statistics import fmean, median

from daedalus.learner.reporting.rates import RunRates
from daedalus.protocol.messages import ClientReport
from daedalus.protocol.texts import one_line, short_duration

_STRAGGLES = 1.5  # times the median of the others' durations
_EXPLAINS = 0.1  # of the wait: from this share on, the round trip is the reason for it


def bottleneck(rates: RunRates, reports: Iterable[ClientReport], *, rollout_length: int, together: bool) -> str:
    """Return what the run waits for, in one line for a person; empty before that is known.

    Args:
      rates: of the learner.
      reports: the newest one of each live actor that reports.
      rollout_length: rows in a rollout.
      together: whether a batch is one rollout of each actor.
    """
    reports = list(reports)
    known = [report for report in reports if report.rollout_seconds > 0.0]
    if not rates.updates_per_second:
        return _before_the_first_batch(reports, rollout_length, together=together)
    works = max(rates.learning_share, rates.decoding_share)
    waits = f"the learner waits {1.0 - works:.0%} of the time"
    if not known:
        return f"{waits} for rollouts; its actors do not report how long they take"
    shares = [report.rollout_seconds / (report.rollout_seconds + report.waiting_seconds) for report in known]
    plays = max(shares) if together else fmean(shares)
    idle = f"actors wait {1.0 - plays:.0%}"
    under_way = 1.0 - plays - works
    if works >= max(plays, under_way):
        what = "computes updates" if works == rates.learning_share else "decodes rollouts"
        return f"learner-bound: the learner {what} {works:.0%} of the time, and {idle} of theirs"
    if plays >= under_way:
        straggler = _straggler(known) if together else ""
        durations = _range(known, [report.rollout_seconds for report in known])
        return straggler or f"actors-bound: {waits} for rollouts; one takes {durations}"
    trips = [report.round_trip_seconds for report in known]
    wait = fmean(report.waiting_seconds for report in known)
    if max(trips) >= _EXPLAINS * wait:
        return f"network-bound: {waits} and {idle}; a round trip takes {_range(known, trips)}"
    return (
        f"transfer-bound: {waits} and {idle} while rollouts and snapshots are under way; a round trip takes only "
        f"{_range(known, trips)}, so their size or number counts"
    )


def _before_the_first_batch(reports: Sequence[ClientReport], rollout_length: int, *, together: bool) -> str:
    """Return how far the rollout of the first batch is that comes last, or first where others do not matter."""
    playing = [report for report in reports if report.rows]
    if not playing:
        return ""
    which = (min if together else max)(playing, key=lambda report: report.rows)
    place = f"row {min(which.rows, rollout_length):,} of {rollout_length:,}"
    takes = f"; one takes {short_duration(which.rollout_seconds)}" if which.rollout_seconds else ""
    return f"the first batch waits for rollouts: {one_line(which.actor)} is at {place}{takes}"


def _straggler(reports: Sequence[ClientReport]) -> str:
    """Return the text about an actor that all others wait for, or an empty text."""
    slowest = max(reports, key=lambda report: report.rollout_seconds)
    others = [report.rollout_seconds for report in reports if report is not slowest]
    if not others or slowest.rollout_seconds < _STRAGGLES * median(others):
        return ""
    return (
        f"straggler: every update waits for {one_line(slowest.actor)}, which takes "
        f"{short_duration(slowest.rollout_seconds)} for a rollout; the others take {short_duration(median(others))}"
    )


def _range(reports: Sequence[ClientReport], values: Sequence[float]) -> str:
    """Return the median of durations, and the longest with its actor."""
    longest = max(values)
    text = short_duration(median(values))
    if len(values) == 1 or short_duration(longest) == text:
        return text
    return f"{text} ({one_line(reports[values.index(longest)].actor)}: {short_duration(longest)})"
