"""Charts of runs: pictures for `daedalus plot`, and SVG for a report. matplotlib draws all of them.

matplotlib is an extra: it is imported when a chart is drawn, and the functions raise ModuleNotFoundError without it.
"""

import io
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daedalus.analysis.comparison import final_returns, incomparable_returns, training_tasks
from daedalus.analysis.learning_curves import STD, Series, series_of, title_of
from daedalus.analysis.recorded_run import RATING, RETURN
from daedalus.analysis.run_groups import Group
from daedalus.analysis.run_results import written
from daedalus.analysis.statistics import performance_profile, profile_interval
from daedalus.learner.reporting.metrics_rows import WIN_RATE
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
_MOST_RATED = 4  # charts of the rating and of win rates
_THRESHOLDS = 200


def draw_curves(groups: Sequence[Group], output: Path, by: str) -> None:
    """Draw return, entropy, value loss and policy lag of groups, one curve each; in games with opponents also ratings.

    Raises OSError, ModuleNotFoundError.

    Args:
      groups: a group of one run is drawn with the standard deviation of its episodes, and with its evaluations.
      output: .png, .svg or .pdf.
      by: "env_steps" or "minutes".
    """
    rated = [name for name in _league_columns(groups) if any(series_of(group, name, by) for group in groups)]
    plotted = _PLOTTED | {name: f"{title_of(name)}, newest policy" for name in rated[:_MOST_RATED]}
    lines = math.ceil(len(plotted) / 2)
    figure = _figure(11, 3.5 * lines)
    axes = figure.subplots(lines, 2, sharex=True)
    several, alone = (any((len(group.runs) > 1) == each for group in groups) for each in (True, False))
    band = "band: one std; circles: evaluations" if alone else ""
    if several:
        band = f"band: 95 % interval of the runs{'; of one run ' if alone else ''}{band.removeprefix('band: ')}"
    if len(training_tasks(groups)) > 1:
        band += "; different tasks in training"
    for axis, (column, title) in zip(axes.flat, plotted.items(), strict=False):
        for index, group in enumerate(groups):
            series = series_of(group, column, by)
            if series is None:
                axis.plot([], color=f"C{index}", label=_label(group))
            else:
                _draw(axis, series, f"C{index}", label=_label(group))
        axis.set_title(title.format(band), fontsize=10)
        axis.ticklabel_format(useOffset=False)  # an offset in a corner would hide what the ticks are
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(plotted) - 2 : len(plotted)]:  # the lowest of each column
        axis.set_xlabel(by)
        axis.tick_params(labelbottom=True)
    for axis in axes.flat[len(plotted) :]:
        axis.set_visible(False)
    axes[0, 0].legend(fontsize=8, loc="lower right")
    _save(figure, output)


def _league_columns(groups: Sequence[Group]) -> list[str]:
    """Return the columns of the rating and of the win rates that the runs have, the rating first."""
    columns = {name for group in groups for run in group.runs for name in run.metrics}
    return [RATING, *sorted(name for name in columns if name.startswith(WIN_RATE))]


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
        label = _label(group) + (": no episode of a run has ended" if np.isnan(scores).any() else "")
        _draw(axis, Series(name=group.name, x=thresholds, y=shares, low=low, high=high), f"C{index}", label)
    axis.ticklabel_format(useOffset=False)
    axis.set_xlabel("return")
    axis.set_ylabel("share of runs with a higher final return")
    axis.set_title("performance profiles (band: 95 % interval)", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower left")
    _save(figure, output)


def _label(group: Group) -> str:
    """Return the name of a group for a legend: printable, and no formula for matplotlib."""
    return one_line(group.label).replace("$", r"\$")


def _figure(width: float, height: float) -> "Figure":
    """Return an empty figure, in inches, that no window and no global state of matplotlib knows."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _draw(axis: "Axes", series: Series, colour: str, label: str = "", style: str = "-") -> None:
    """Draw a line, its band and its marks."""
    marker = "o" if len(series.x) == 1 else ""  # a line of one point shows nothing
    axis.plot(series.x, series.y, style, color=colour, label=label, linewidth=1.5, marker=marker, markersize=4)
    if series.low is not None and series.high is not None:
        axis.fill_between(series.x, series.low, series.high, color=colour, alpha=0.15, linewidth=0)
    if series.marks is not None:
        axis.plot(*series.marks, "o", color=colour, markersize=4, clip_on=False)  # also at an end of the axis


def _save(figure: "Figure", output: Path) -> None:
    """Write the picture. Raises OSError."""
    with replacing(output) as beside:
        figure.savefig(beside, dpi=110, format=output.suffix[1:])


# The charts of a report. Their colours are variables of its style sheet, which has others for a dark page: matplotlib
# draws with a placeholder for each variable.

SERIES_COLOURS = 8  # further series repeat them with dashes
_VARIABLES = [*(f"--series-{index + 1}" for index in range(SERIES_COLOURS)), "--muted", "--grid", "--bar", "--panel"]
_PLACEHOLDERS = {name: f"#0000{number:02x}" for number, name in enumerate(_VARIABLES, start=1)}
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text that the browser writes in its own font
    "font.family": "DejaVu Sans",
    "font.size": 11,
    "xtick.color": _PLACEHOLDERS["--muted"],
    "ytick.color": _PLACEHOLDERS["--muted"],
    "axes.labelcolor": _PLACEHOLDERS["--muted"],
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": _PLACEHOLDERS["--grid"],
    "axes.xmargin": 0.0,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    **{f"{axis}tick.major.size": 0.0 for axis in "xy"},
}
SMALL, LARGE = (520, 220), (1180, 340)  # width and height of a chart, in points
_METADATA = ("Creator", "Date", "Format", "Type")  # is left out
_MOST_POINTS = 400
_MOST_BINS = 40


def line_chart(
    title: str, series: Sequence[Series], *, unit: str, colours: Sequence[int], size: tuple[int, int] = SMALL
) -> ET.Element:
    """Return a chart of lines as an element `svg`.

    Args:
      title: what the lines show; each chart of a page needs a title of its own.
      series: the lines, each with at least one point.
      unit: of the horizontal axis.
      colours: the colour of each line, from 0 on.
      size: width and height.
    """
    ends = "; ".join(
        f"{each.name + ': ' if len(series) > 1 else ''}from {written(float(each.y[0]))} to {written(float(each.y[-1]))}"
        for each in series[:SERIES_COLOURS]
    )
    with _chart(title, f"{title} by {unit}: {ends}", unit, size) as (axis, svg):
        for each, colour in zip(series, colours, strict=True):
            style = "-" if colour < SERIES_COLOURS else "--"
            _draw(axis, _thinned(each), _PLACEHOLDERS[f"--series-{colour % SERIES_COLOURS + 1}"], style=style)
        axis.ticklabel_format(useOffset=False)
    return svg


def histogram(title: str, values: np.ndarray, *, marks: Sequence[tuple[str, float]], unit: str) -> ET.Element:
    """Return a histogram of finite values, with vertical lines at named numbers, as an element `svg`."""
    named = ", ".join(f"{name} {written(at)}" for name, at in marks)
    text = f"{title}: {len(values):,} from {written(values.min())} to {written(values.max())}, {named}"
    counts, edges = np.histogram(values, _edges(values))
    with _chart(title, text, unit) as (axis, svg):
        bars, panel = _PLACEHOLDERS["--bar"], _PLACEHOLDERS["--panel"]
        axis.bar(edges[:-1], counts, np.diff(edges), align="edge", color=bars, edgecolor=panel)
        for index, (_, at) in enumerate(marks):
            axis.axvline(at, color=_PLACEHOLDERS[f"--series-{index + 2}"], linestyle=("-", "--")[index], linewidth=1.8)
        axis.ticklabel_format(useOffset=False)
        axis.locator_params(axis="y", integer=True)
    return svg


@contextmanager
def _chart(
    title: str, description: str, unit: str, size: tuple[int, int] = SMALL
) -> "Iterator[tuple[Axes, ET.Element]]":
    """Give an axis to draw on, and the element that has the chart at the end."""
    import matplotlib

    svg, file = ET.Element("svg"), io.StringIO()
    salt = f"{title} {size}"  # the names in two charts of a page must differ
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": salt}):
        figure = _figure(size[0] / 72, size[1] / 72)  # inches of 72 points, the unit of the SVG
        axis = figure.subplots()
        axis.set_xlabel(unit, loc="right")
        yield axis, svg
        figure.savefig(file, format="svg", transparent=True, metadata=dict.fromkeys(_METADATA))
    variables = {colour: f"var({name})" for name, colour in _PLACEHOLDERS.items()}
    drawn = ET.fromstring(re.sub("#0000[0-9a-f]{2}", lambda found: variables[found[0]], file.getvalue()))
    for part in drawn.iter():  # in HTML the elements have no namespaces
        part.tag = part.tag.rpartition("}")[2]
        part.attrib = {name.rpartition("}")[2]: value for name, value in part.attrib.items()}
        if part.tag == "g":
            part.attrib.pop("id", None)  # such as "axes_1", in each chart
    svg.attrib = {"viewBox": drawn.attrib["viewBox"], "role": "img", "aria-label": description}
    svg.extend(drawn)


def _edges(values: np.ndarray) -> np.ndarray:
    """Return the edges of bins that hold all values: twice as many as Sturges' rule has, or one for equal values."""
    low, high = float(values.min()), float(values.max())
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        margin = max(0.5, 1e-6 * abs(low))
        return np.array([low - margin, high + margin])
    return np.linspace(low, high, min(2 * math.ceil(math.log2(len(values)) + 2), _MOST_BINS) + 1)


def _thinned(series: Series) -> Series:
    """Return a series with at most _MOST_POINTS points: the ends, and between them means of neighbours."""
    if len(series.x) <= _MOST_POINTS:
        return series
    inner = np.linspace(1, len(series.x) - 1, _MOST_POINTS - 2, endpoint=False).astype(np.int64)
    starts = np.concatenate([[0], inner, [len(series.x) - 1]])
    counts = np.diff(np.append(starts, len(series.x)))
    columns = {name: getattr(series, name) for name in ("x", "y", "low", "high")}
    means = {name: np.add.reduceat(part, starts) / counts for name, part in columns.items() if part is not None}
    return replace(series, **means)
