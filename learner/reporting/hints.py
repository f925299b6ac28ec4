"""Lines for the user: what a run waits for, and hints where it does not learn, or no episode ends. No I/O.

The learner measures the shares of its time in which it computes updates and decodes rollouts (rates.py). Each actor
measures how long a rollout takes it, and how long it then waits (ClientReport). An actor waits for the learner at most
while that works. So what is left of the time, without a working learner or a playing actor, goes to what is under way.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean, median

from daedalus.learner.reporting.rates import RunRates
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.fleet import Fleet
from daedalus.protocol.messages import ClientReport
from daedalus.protocol.spaces import StillObservations
from daedalus.protocol.spec import TrainingSpec
from daedalus.protocol.texts import exact_number, one_line, short_duration, short_number
from daedalus.protocol.uploads import Rollout, Upload

_BASELINE_EPISODES = 20  # after so many, the policy is still about as random as at the start,
_BASELINE_PROGRESS = 0.05  # unless they took more than this share of the budget
_JUDGED_PROGRESS, _WATCHED_PROGRESS = 0.2, 0.1  # shares of the budget: of the judgement, and of the rows that count
_LEAST_ROWS = 5
_BETTER = 0.25  # standard deviations of the first episodes by which a mean return is better
_COLLAPSED = 0.1  # of the first entropy
_EXPLAINS = 0.001  # explained variance of a value that does not depend on the observation, or hardly


class LearningHint:
    """Judge of a run after a fifth of its budget, by its metrics rows.

    A run has nothing to learn from where all returns are equal. It does not learn where the entropy has collapsed or
    the explained variance stayed at or below 0, unless the mean return is higher than that of the first episodes, or
    the newest evaluation better than the first. Runs that were resumed after the first episodes are not judged, nor
    games with opponents, whose returns say nothing about the strength of play.
    """

    def __init__(self, training: TrainingSpec) -> None:
        """Construct the judge of a run with these settings."""
        self._budget, self._normalizes_rewards = training.env_steps, training.normalize_rewards
        self._is_curious = training.curiosity > 0.0
        self._first_return: tuple[float, float] | None = None  # mean and standard deviation
        self._first_entropy: float | None = None
        self._explained: list[float] = []
        self._evaluations: list[tuple[float, float]] = []  # as _first_return; the first and the newest
        self._lowest, self._highest = math.inf, -math.inf  # returns in all rows
        self._judged = False
        self._due = ""

    def add(self, row: Mapping[str, float]) -> None:
        """Add a metrics row."""
        progress = row["env_steps"] / self._budget
        self._judged = self._judged or "rating" in row
        if self._judged:
            return
        has_returns = "episode_return_mean" in row  # not before the first episode, and after a target not confirmed
        if has_returns:
            self._lowest = min(self._lowest, row["episode_return_min"])
            self._highest = max(self._highest, row["episode_return_max"])
        if self._first_entropy is None:
            self._first_entropy = row.get("entropy")
        if self._first_return is None and has_returns and row["episodes"] >= _BASELINE_EPISODES:
            if progress > _BASELINE_PROGRESS:
                self._judged = True
                return
            self._first_return = row["episode_return_mean"], row["episode_return_std"]
        if "evaluation_return_mean" in row:
            newest = row["evaluation_return_mean"], row.get("evaluation_return_std", 0.0)
            self._evaluations = [*(self._evaluations[:1] or [newest]), newest]
        if progress >= _WATCHED_PROGRESS and "explained_variance" in row:
            self._explained.append(row["explained_variance"])
        if progress >= _JUDGED_PROGRESS and has_returns:
            self._judged = True
            self._due = self._judgement(row)

    def take(self) -> str:
        """Return the hint if it is due, once, else an empty string."""
        due, self._due = self._due, ""
        return due

    def _judgement(self, row: Mapping[str, float]) -> str:
        if self._first_return is None:
            return ""
        trained = self._first_return, (row["episode_return_mean"], 0.0)
        for (before, deviation), *_, (now, _) in (trained, self._evaluations or trained):
            if now > before + _BETTER * deviation:
                return ""
        if self._lowest == self._highest:
            explore = "" if self._is_curious else "; training.curiosity=1 explores more, where observations come back"
            return (
                "this run has nothing to learn from: every episode so far has the return "
                f"{exact_number(self._lowest)}, so that no action was better than another; check the reward, and "
                f"whether random actions can reach the goal{explore}"
            )
        first, entropy = self._first_entropy or 0.0, row.get("entropy", 0.0)
        returns = f"after a fifth of the budget the mean return is {short_number(row['episode_return_mean'])}"
        returns += f", and was {short_number(self._first_return[0])} at the start"
        if first > 0.0 and entropy < _COLLAPSED * first:
            return (
                f"this run does not learn: {returns}, and the entropy fell from {first:.3g} to {entropy:.3g}, so the "
                "policy explores no more; try a larger training.entropy_bonus or a smaller training.learning_rate"
            )
        if len(self._explained) >= _LEAST_ROWS and max(self._explained) < _EXPLAINS:
            normalize = "" if self._normalizes_rewards else "training.normalize_rewards=true or "
            return (
                f"this run does not learn: {returns}, and the value explains nothing of the returns; "
                f"try {normalize}a smaller training.learning_rate"
            )
        return ""


_LOOKED_AT = 4096  # rows whose observations are compared


class ObservationHint:
    """Hint that the observations of the first rollouts, or a component of them, did not change; given once."""

    def __init__(self) -> None:
        self._still, self._rows, self._episodes = StillObservations(), 0, 0
        self._due = ""

    def look(self, uploads: Sequence[Upload]) -> None:
        """Look at a batch. Gradients show no observations."""
        for rollout in uploads:
            if self._rows >= _LOOKED_AT or not isinstance(rollout, Rollout):
                return
            rows = rollout.rows + 1  # without the frames before the first row
            goes_on = rollout.valid & ~(rollout.terminated | rollout.truncated)
            self._still.add({name: frames[-rows:] for name, frames in rollout.frames.items()}, goes_on)
            self._rows += goes_on.size
            self._episodes += len(rollout.episode_returns)
            if self._rows >= _LOOKED_AT:
                self._due = self._still.text(self._episodes)

    def take(self) -> str:
        """Return the hint if it is due, once, else an empty string."""
        due, self._due = self._due, ""
        return due


# env_steps in each environment without the end of an episode after which a hint is given; the least in a small budget.
_LONG_EPISODE, _USUAL_EPISODE = 10_000, 2_000


class EpisodeHint:
    """Hint that no episode has ended after many steps, or after half of a small budget; given once."""

    def __init__(self, budget: int, remedy: str) -> None:
        """Construct from the budget in env_steps, and what to do about episodes that do not end."""
        self._budget, self._remedy, self._given = budget, remedy, False

    def take(self, counters: RunCounters, fleet: Fleet) -> str:
        """Return the hint if it is due, else an empty string."""
        environments = max(sum(fleet.actors[name].environments for name in fleet.live), 1)
        length = min(_LONG_EPISODE, max(_USUAL_EPISODE, self._budget // (2 * environments)))
        if self._given or counters.episodes or counters.env_steps < environments * length:
            return ""
        self._given = True
        return f"no episode has ended after {length:,} env_steps in each environment: {self._remedy}"


_STRAGGLES = 1.5  # times the median of the others' durations
_TRIP_EXPLAINS = 0.1  # of the wait: from this share on, the round trip is the reason for it


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
    if max(trips) >= _TRIP_EXPLAINS * wait:
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
