"""Charts of runs for `daedalus plot`, as matplotlib draws them.

matplotlib is an extra: it is imported when a chart is drawn, and the functions raise ModuleNotFoundError without it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daedalus.analysis.comparison import final_returns, incomparable_returns, training_tasks
from daedalus.analysis.learning_curves import STD, Series, series_of
from daedalus.analysis.recorded_run import RETURN
from daedalus.analysis.run_groups import Group
from daedalus.analysis.statistics import performance_profile, profile_interval
from daedalus.learner.run.run_files import RunDataError
from daedalus.policy.saving.regular_files import replacing
from daedalus.protocol.texts import one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INSTALL = 'matplotlib is not installed: pip install "daedalus-rl[analysis]"'

_PLOTTED = {
    RETURN: "return (mean of the last episodes, {})",
    "entropy": "entropy (nats)",
    "value_loss": "value loss",
    "policy_lag_mean": "policy lag (updates)",
}
COLUMNS = (*_PLOTTED, STD)  # that `draw_curves` needs
_THRESHOLDS = 200


def draw_curves(groups: Sequence[Group], output: Path, by: str) -> None:
    """Draw return, entropy, value loss and policy lag of groups, one curve each. Raises OSError, ModuleNotFoundError.

    Args:
      groups: a group of one run is drawn with the standard deviation of its episodes, and with its evaluations.
      output: .png, .svg or .pdf.
      by: "env_steps" or "minutes".
    """
    figure = _figure(11, 7)
    axes = figure.subplots(2, 2, sharex=True)
    several = any(len(group.runs) > 1 for group in groups)
    band = "band: 95 % interval of the runs" if several else "band: one std; circles: evaluations"
    if len(training_tasks(groups)) > 1:
        band += "; different tasks in training"
    for axis, (column, title) in zip(axes.flat, _PLOTTED.items(), strict=True):
        for index, group in enumerate(groups):
            series = series_of(group, column, by)
            if series is None:
                axis.plot([], color=f"C{index}", label=_label(group))
            else:
                _draw(axis, series, f"C{index}", label=_label(group))
        axis.set_title(title.format(band), fontsize=10)
        axis.ticklabel_format(useOffset=False)  # an offset in a corner would hide what the ticks are
        axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel(by)
    axes[0, 0].legend(fontsize=8, loc="lower right")
    _save(figure, output)


def draw_profiles(groups: Sequence[Group], output: Path) -> None:
    """Draw the performance profile of each group: the share of its runs above a return.

    Raises RunDataError without any return, OSError and ModuleNotFoundError.
    """
    figure = _figure(7, 4.5)
    evaluated = all(run.evaluation_return is not None for group in groups for run in group.runs)
    returns = [final_returns(group, evaluated=evaluated) for group in groups]
    if problem := incomparable_returns(groups):
        raise RunDataError(problem)
    every = np.concatenate(returns)
    every = every[~np.isnan(every)]
    if not len(every):
        raise RunDataError("no episode of these runs has ended: there is no final return")
    margin = (np.ptp(every) or abs(every[0]) or 1.0) * 0.05
    thresholds = np.linspace(every.min() - margin, every.max() + margin, _THRESHOLDS)
    axis = figure.subplots()
    for index, (group, scores) in enumerate(zip(groups, returns, strict=True)):
        low, high = profile_interval([scores], thresholds)
        shares = performance_profile([scores], thresholds)
        _draw(axis, Series(name=group.name, x=thresholds, y=shares, low=low, high=high), f"C{index}", _label(group))
    axis.ticklabel_format(useOffset=False)
    axis.set_xlabel("return")
    axis.set_ylabel("share of runs with a higher final return")
    axis.set_title("performance profiles (band: 95 % interval)", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower left")
    _save(figure, output)


def _label(group: Group) -> str:
    """Return the name of a group for a legend: printable, and no formula for matplotlib."""
    runs = f" ({len(group.runs)} runs)" if len(group.runs) > 1 else ""
    return one_line(group.name).replace("$", r"\$") + runs


def _figure(width: float, height: float) -> "Figure":
    """Return an empty figure, in inches, that no window and no global state of matplotlib knows."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _draw(axis: "Axes", series: Series, colour: str, label: str) -> None:
    """Draw a line, its band and its marks."""
    marker = "o" if len(series.x) == 1 else ""  # a line of one point shows nothing
    axis.plot(series.x, series.y, color=colour, label=label, linewidth=1.5, marker=marker, markersize=4)
    if series.low is not None and series.high is not None:
        axis.fill_between(series.x, series.low, series.high, color=colour, alpha=0.15, linewidth=0)
    if series.marks is not None:
        axis.plot(*series.marks, "o", color=colour, markersize=4, clip_on=False)  # also at an end of the axis


def _save(figure: "Figure", output: Path) -> None:
    """Write the picture. Raises OSError."""
    with replacing(output) as beside:
        figure.savefig(beside, dpi=110, format=output.suffix[1:])
