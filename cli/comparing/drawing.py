"""Pictures of groups of runs. Imports matplotlib, an extra, when a picture is drawn."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daedalus.cli.comparing.comparison import final_returns, incomparable_returns, training_tasks
from daedalus.cli.comparing.curves import evaluations, group_curve, points
from daedalus.cli.comparing.grouping import Group
from daedalus.cli.comparing.recorded_run import RETURN
from daedalus.cli.comparing.statistics import performance_profile, profile_interval
from daedalus.learner.run.run_files import RunDataError
from daedalus.policy.saving.regular_files import replacing
from daedalus.protocol.texts import one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INSTALL = 'matplotlib is not installed: pip install "daedalus-rl[plot]"'
_STD = "episode_return_std"
_TITLES = {
    RETURN: "return (mean of the last episodes, {})",
    "entropy": "entropy (nats)",
    "value_loss": "value loss",
    "policy_lag_mean": "policy lag (updates)",
}
COLUMNS = (*_TITLES, _STD)  # that `draw_curves` needs
_THRESHOLDS = 200


def draw_curves(groups: Sequence[Group], output: Path, by: str) -> None:
    """Draw return, entropy, value loss and policy lag of groups, one curve each. Raises OSError, ModuleNotFoundError.

    Args:
      groups: a group of one run is drawn with the standard deviation of its episodes, and with its evaluations.
      output: .png, .svg or .pdf.
      by: "env_steps" or "minutes".
    """
    plt = _pyplot()
    figure, axes = plt.subplots(2, 2, figsize=(11, 7), sharex=True, layout="constrained")
    several = any(len(group.runs) > 1 for group in groups)
    band = "band: 95 % interval of the runs" if several else "band: one std; circles: evaluations"
    if len(training_tasks(groups)) > 1:
        band += "; different tasks in training"
    for axis, (column, title) in zip(axes.flat, _TITLES.items(), strict=True):
        for group in groups:
            if len(group.runs) > 1:
                _draw_group(axis, group, column, by)
            else:
                _draw_run(axis, group, column, by)
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
    plt = _pyplot()
    evaluated = all(run.evaluation is not None for group in groups for run in group.runs)
    returns = [final_returns(group, evaluated=evaluated) for group in groups]
    if problem := incomparable_returns(groups):
        raise RunDataError(problem)
    every = np.concatenate(returns)
    every = every[~np.isnan(every)]
    if not len(every):
        raise RunDataError("no episode of these runs has ended: there is no final return")
    margin = (np.ptp(every) or abs(every[0]) or 1.0) * 0.05
    thresholds = np.linspace(every.min() - margin, every.max() + margin, _THRESHOLDS)
    figure, axis = plt.subplots(figsize=(7, 4.5), layout="constrained")
    for group, scores in zip(groups, returns, strict=True):
        (line,) = axis.plot(thresholds, performance_profile([scores], thresholds), label=_label(group))
        low, high = profile_interval([scores], thresholds)
        axis.fill_between(thresholds, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
    axis.ticklabel_format(useOffset=False)
    axis.set_xlabel("return")
    axis.set_ylabel("share of runs with a higher final return")
    axis.set_title("performance profiles (band: 95 % interval)", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower left")
    _save(figure, output)


def _label(group: Group) -> str:
    """Return the name of a group, printable, and no formula for matplotlib."""
    return one_line(group.name).replace("$", r"\$")


def _pyplot():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _save(figure, output: Path) -> None:
    """Write the picture. Raises OSError."""
    import matplotlib.pyplot as plt

    try:
        with replacing(output) as beside:
            figure.savefig(beside, dpi=110, format=output.suffix[1:])
    finally:
        plt.close(figure)


def _draw_group(axis: "Axes", group: Group, column: str, by: str) -> None:
    curve = group_curve(group.runs, column, by)
    if curve is None:
        axis.plot([], label=_label(group))
        return
    (line,) = axis.plot(curve.x, curve.mean, label=f"{_label(group)} ({len(group.runs)} runs)", linewidth=1.5)
    axis.fill_between(curve.x, curve.low, curve.high, color=line.get_color(), alpha=0.15, linewidth=0)


def _draw_run(axis: "Axes", group: Group, column: str, by: str) -> None:
    (run,) = group.runs
    x, y = points(run, column, by)
    (line,) = axis.plot(x, y, label=_label(group), linewidth=1.5)
    if column == RETURN:
        std_x, std = points(run, _STD, by)
        std = np.interp(x, std_x, std) if len(std) else np.zeros(len(x))
        axis.fill_between(x, y - std, y + std, color=line.get_color(), alpha=0.15, linewidth=0)
        axis.plot(*evaluations(run, by), "o--", color=line.get_color(), linewidth=1, markersize=4)
