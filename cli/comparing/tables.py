"""A comparison as a table for a terminal, and as CSV. Pure functions."""

import csv
import io
import math
from collections.abc import Callable, Sequence

from daedalus.cli.comparing.comparison import Comparison, Estimate, GroupResult
from daedalus.protocol.texts import exact_number, one_line, printable, short_number

_FEW = 5  # runs


def as_text(comparison: Comparison) -> str:
    """Return the table of a comparison, with what its columns mean."""
    head = header(comparison)
    rows = [cells(result, comparison) for result in comparison.results]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in [head, *rows]
    ]
    lines.insert(1, "  ".join("-" * width for width in widths))
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
    if comparison.incomparable:
        lines.append(comparison.incomparable)
    if comparison.other_task and comparison.threshold is not None:
        lines.append(
            "reached, env_steps and minutes: by evaluations during training (evaluation.seconds; -: there were none), "
            "because training plays another task (environment.training_kwargs or environment.no_reward_limit)"
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
    "group",
    "runs",
    "reached",
    "threshold",
    *(f"{name}{end}" for name in _ESTIMATES for end in ("", "_low", "_high")),
]


def as_csv(comparison: Comparison) -> str:
    """Return the table as CSV, one line for each group; blank: unknown; inf: not reached."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    writer.writerow(_HEADER)
    for result in comparison.results:
        numbers: list[float | None] = [result.reached, comparison.threshold]
        for name in _ESTIMATES:
            numbers += getattr(result, name) or (None, None, None)
        writer.writerow([one_line(result.group), result.runs, *_blank(numbers)])
    return stream.getvalue()


def _blank(numbers: Sequence[float | None]) -> list[str]:
    return ["" if number is None or math.isnan(number) else exact_number(number) for number in numbers]
