"""Comparison of groups of runs: final return, env_steps and minutes to a threshold, improvement; as a table and as CSV.

Pure functions."""

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from daedalus.analysis.recorded_run import RATING, RecordedRun
from daedalus.analysis.run_groups import Group, environment_of
from daedalus.analysis.statistics import (
    Strata,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
    probability_of_improvement,
)
from daedalus.learner.run.settings import value_text
from daedalus.protocol.texts import aligned, exact_number, one_line, printable, short_number


class Estimate(NamedTuple):
    """A statistic and its 95 % interval; infinite: the threshold was not reached; NaN: unknown."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupResult:
    """Results of a group."""

    group: str
    runs: int
    final_return: Estimate  # interquartile mean, as the following two
    reached: int | None  # number of runs that reached the threshold; None without a threshold, as the following two
    env_steps: Estimate | None
    minutes: Estimate | None
    improvement: Estimate | None  # probability of a higher final return than the first group; None for that group


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Results of all groups."""

    environment: str
    evaluated: bool  # whether the final return is that of the final evaluation, and not of the last training episodes
    threshold: float | None
    results: Sequence[GroupResult]
    other_task: bool = False  # whether a run trains on another task than that of evaluations
    rated: bool = False  # whether a run is a game with opponents
    incomparable: str = ""  # why the final returns are not compared
    played: Sequence[str] = ()  # how the final evaluations were played, such as "greedy on gymnasium"
    stopped: int = 0  # number of runs that were stopped before their end, and evaluated all the same
    unnamed: Sequence[str] = ()  # settings in which the groups differ, and that are not in their names


def compare_groups(groups: Sequence[Group], threshold: float | None = None) -> Comparison:
    """Return the results of groups of runs.

    Args:
      groups: the groups, each with at least one run.
      threshold: mean return whose env_steps and minutes are compared (default: the target return, if all runs have one
        and it is the same). If a run trains on another task than that of evaluations, evaluations have to reach it.
    """
    runs = [run for group in groups for run in group.runs]
    targets = {run.target for run in runs}
    if threshold is None and len(targets) == 1:
        threshold = targets.pop()
    evaluated = all(run.evaluation_return is not None for run in runs)
    other_task = not all(run.trains_true_task for run in runs)
    returns = [final_returns(group, evaluated=evaluated) for group in groups]
    if problem := incomparable_returns(groups):
        returns = [np.full(len(values), np.nan) for values in returns]
    results = []
    for index, group in enumerate(groups):
        env_steps = minutes = None
        if threshold is not None:
            env_steps, minutes = np.array([run.reached(threshold, evaluated=other_task) for run in group.runs]).T
            if np.isnan(env_steps).any():
                env_steps, minutes = np.full_like(env_steps, np.nan), np.full_like(minutes, np.nan)
        results.append(
            GroupResult(
                group=group.name,
                runs=len(group.runs),
                final_return=estimate([returns[index]]),
                reached=None if env_steps is None else _finite(env_steps),
                env_steps=None if env_steps is None else estimate([env_steps]),
                minutes=None if minutes is None else estimate([minutes]),
                improvement=improvement([returns[index]], [returns[0]]) if index else None,
            )
        )
    return Comparison(
        environment=environment_of(groups),
        evaluated=evaluated,
        threshold=threshold,
        results=results,
        unnamed=groups[0].unnamed,
        other_task=other_task,
        rated=any(not np.isnan(run.metrics.get(RATING, np.nan)).all() for run in runs),
        incomparable=problem,
        stopped=sum(run.was_stopped and run.evaluation_return is not None for run in runs),
        played=sorted({how_played(run) for run in runs} - {""}) if evaluated else (),
    )


def _finite(env_steps: np.ndarray) -> int | None:
    """Return how many runs reached a threshold, or None if it is not known of all."""
    return None if np.isnan(env_steps).any() else int(np.isfinite(env_steps).sum())


def training_tasks(groups: Sequence[Group]) -> set[str]:
    """Return what makes the tasks that the runs train on differ from those of their evaluations, as texts."""
    played = [(run, run.environment) for group in groups for run in group.runs if run.environment is not None]
    return {
        "" if run.trains_true_task else value_text([task.training_kwargs, task.no_reward_limit, run.lessons])
        for run, task in played
    }


def incomparable_returns(groups: Sequence[Group]) -> str:
    """Return why final returns cannot be compared: some are of training, on different tasks. Else an empty string."""
    runs = [run for group in groups for run in group.runs]
    without = [run for run in runs if run.evaluation_return is None]
    if not without or len(training_tasks(groups)) < 2:
        return ""
    return (
        "final returns cannot be compared: training plays different tasks (environment.training_kwargs, "
        "environment.no_reward_limit or lessons) and not all runs were evaluated; evaluate them, such as with: "
        f"{without[0].record_command}"
    )


def how_played(run: RecordedRun) -> str:
    """Return the actions and the backend of the final evaluation of a run; empty if they are not known."""
    found = run.summary.get("evaluation")
    return f"{found.get('actions')} on {found.get('backend')}" if isinstance(found, dict) else ""


def final_returns(group: Group, *, evaluated: bool) -> np.ndarray:
    """Return the final return of each run, [runs]: of its final evaluation, or of its last training episodes."""
    values = [run.evaluation_return if evaluated else run.training_return for run in group.runs]
    return np.array([math.nan if value is None else value for value in values])


def estimate(strata: Strata) -> Estimate:
    """Return the interquartile mean of the runs of all tasks, with its interval."""
    interval = interquartile_interval(strata)
    mean = interquartile_mean(np.concatenate(strata))
    return Estimate(float(mean), float(interval.low), float(interval.high))


def improvement(strata: Strata, first: Strata) -> Estimate:
    """Return the probability that a run has a higher score than one of `first`, with its interval."""
    interval = improvement_interval(strata, first)
    return Estimate(probability_of_improvement(strata, first), float(interval.low), float(interval.high))


_FEW = 5  # runs


def as_text(comparisons: Sequence[Comparison]) -> str:
    """Return a table for each comparison, with what its columns mean."""
    if len(comparisons) == 1:
        return _table(comparisons[0])
    return "\n\n\n".join(f"{_heading(comparison)}\n\n{_table(comparison)}" for comparison in comparisons)


def _heading(comparison: Comparison) -> str:
    runs = sum(result.runs for result in comparison.results)
    return printable(f"{comparison.environment or 'unknown environment'}: {runs} {'run' if runs == 1 else 'runs'}")


def _table(comparison: Comparison) -> str:
    rows = [header(comparison), *(cells(result, comparison) for result in comparison.results)]
    lines = aligned(rows)
    lines.insert(1, "  ".join("-" * max(map(len, column)) for column in zip(*rows, strict=True)))
    return "\n".join(printable(line) for line in [*lines, "", *notes(comparison)])


def header(comparison: Comparison) -> list[str]:
    """Return the names of the columns."""
    names = ["group", "runs", "final return"]
    threshold = comparison.threshold
    if threshold is not None:
        shown = exact_number(threshold)
        names += ["reached", f"env_steps to {shown}", f"minutes to {shown}"]
    if len(comparison.results) > 1:
        names.append("P(> first)")
    return names


def cells(result: GroupResult, comparison: Comparison) -> list[str]:
    """Return the cells of one group, one for each name of `header`."""
    texts = [result.group, str(result.runs), written(result.final_return, short_number)]
    if result.env_steps is not None and result.minutes is not None:
        texts.append("-" if result.reached is None else f"{result.reached} of {result.runs}")
        texts += [written(result.env_steps, lambda value: f"{value:,.0f}"), written(result.minutes, short_number)]
    if len(comparison.results) > 1:
        improvement = result.improvement
        texts.append("" if improvement is None else written(improvement, lambda value: f"{value:.2f}"))
    return texts


def notes(comparison: Comparison) -> list[str]:
    """Return what the columns mean, one line each."""
    kind = "the final evaluation" if comparison.evaluated else "the last training episodes"
    lines = [
        f"{comparison.environment or 'runs'}: interquartile mean over the runs [95 % bootstrap interval]; "
        f"final return: mean of {kind}"
    ]
    if len(comparison.results) > 1:
        lines.append(
            "P(> first): probability that a run has a higher final return than one of the first group; "
            "0.5 if they are equal"
        )
    if comparison.rated:
        lines.append(
            "games with opponents: what one side wins, the other loses, so that returns of self-play say nothing about "
            "the strength of play; let the policies play: daedalus evaluate RUN --against RUN2"
        )
    if comparison.stopped:
        lines.append(f"{comparison.stopped} of the runs were stopped before their end, and evaluated all the same")
    if len(comparison.played) > 1:
        lines.append(f"the final evaluations were played in different ways: {', '.join(comparison.played)}")
    if comparison.incomparable:
        lines.append(comparison.incomparable)
    elif any(math.isnan(result.final_return.value) for result in comparison.results):
        lines.append("final return -: in a run of the group no episode has ended")
    if comparison.other_task and comparison.threshold is not None:
        lines.append(
            "reached, env_steps and minutes: by evaluations during training (evaluation.seconds; -: there were none), "
            "because training plays another task (environment.training_kwargs, environment.no_reward_limit or "
            "lessons)"
        )
    if comparison.unnamed:
        lines.append(f"the groups also differ in {', '.join(comparison.unnamed)}")
    if comparison.threshold is None:
        lines.append("env_steps and minutes to a return: name the return with `daedalus compare --threshold`")
    if any(1 < result.runs < _FEW for result in comparison.results):
        lines.append(f"intervals of fewer than {_FEW} runs are too narrow: train more seeds")
    single = [result.group for result in comparison.results if result.runs == 1]
    if single:
        named = " and ".join(single) if len(single) < 3 else f"{len(single)} groups"
        lines.append(f"one run only, so without an interval: {named}; train more seeds")
    return lines


def written(estimate: Estimate, form: Callable[[float], str]) -> str:
    """Return an estimate as `1.5 [1.2, 1.9]`, or without an interval if it is unknown."""

    def shown(value: float) -> str:
        return "-" if math.isnan(value) else "never" if math.isinf(value) else form(value)

    if math.isnan(estimate.low) or estimate.low == estimate.high == math.inf:
        return shown(estimate.value)
    return f"{shown(estimate.value)} [{shown(estimate.low)}, {shown(estimate.high)}]"


_ESTIMATES = ("final_return", "env_steps", "minutes", "improvement")
_HEADER = [
    "environment",
    "group",
    "runs",
    "reached",
    "threshold",
    *(f"{name}{end}" for name in _ESTIMATES for end in ("", "_low", "_high")),
]


def as_csv(comparisons: Sequence[Comparison]) -> str:
    """Return the tables as CSV, one line for each group; blank: unknown; inf: not reached."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    writer.writerow(_HEADER)
    for comparison in comparisons:
        for result in comparison.results:
            numbers: list[float | None] = [result.reached, comparison.threshold]
            for name in _ESTIMATES:
                numbers += getattr(result, name) or (None, None, None)
            names = one_line(comparison.environment), one_line(result.group)
            writer.writerow([*names, result.runs, *_blank(numbers)])
    return stream.getvalue()


def _blank(numbers: Sequence[float | None]) -> list[str]:
    return ["" if number is None or math.isnan(number) else exact_number(number) for number in numbers]
