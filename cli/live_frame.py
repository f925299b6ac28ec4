"""What a live display shows of runs, as text for rich. Pure functions.

Texts of peers, such as the names of actors, are in one line, without control characters and never read as markup.
"""

from collections.abc import Sequence
from itertools import pairwise

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from daedalus.cli.run_watcher import WatchedRun
from daedalus.learner.reporting.progress import duration
from daedalus.protocol.messages import ActorStatus, RunStatus
from daedalus.protocol.texts import one_line, policy_lag, short_number, short_rate, short_share

BLOCKS, ASCII = "▁▂▃▄▅▆▇█", "_.-=+*#@"


def sparkline(values: Sequence[float], width: int, levels: str = BLOCKS) -> str:
    """Return a curve of at most `width` characters.

    Args:
      values: finite numbers. If there are more than `width`, each character is the mean of neighbours.
      width: in characters.
      levels: characters from the lowest to the highest.
    """
    if not values or width < 1:
        return ""
    columns = min(width, len(values))
    edges = [len(values) * index // columns for index in range(columns + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in pairwise(edges)]
    low, high = min(means), max(means)
    scale = (len(levels) - 1) / (high - low) if high > low else 0.0
    return "".join(levels[round((mean - low) * scale)] for mean in means)


_WIDE = 60  # columns
_SPARKLINE_WIDTH = 60  # at most
_HEAD_LINES = 5  # of a run, without its problems and its actors
_SHOWN_PROBLEMS = 3

# Columns of the table with the width that a terminal needs to show them.
_COLUMNS = (("actor", 0), ("state", 0), ("env_steps", 60), ("/s", 0), ("lag", 50), ("busy", 56), ("host", 90))


def frame(runs: Sequence[WatchedRun], width: int, height: int, *, ascii_only: bool = False) -> RenderableType:
    """Return all runs, as many lines as fit.

    Args:
      runs: the runs.
      width: columns of the terminal.
      height: lines of the terminal. Actors beyond it are counted.
      ascii_only: the terminal shows no other characters.
    """
    actors = max(height - 1, 0) // max(len(runs), 1) - _HEAD_LINES - 2
    return Group(*(part for run in runs for part in _run(run, width, max(actors, 0), ascii_only)))


def summary_frame(run: WatchedRun, width: int, *, ascii_only: bool = False) -> RenderableType:
    """Return the last frame of a run: without its actors, which have left."""
    return Group(*_head(run, width, ascii_only))


def _run(run: WatchedRun, width: int, lines: int, ascii_only: bool) -> list[RenderableType]:
    """Return a run with as many actors as fit into `lines`."""
    status = run.status
    notes = [_line([f"PROBLEM: {problem}"], width, "yellow") for problem in status.problems[:_SHOWN_PROBLEMS]]
    notes += [_line([status.bottleneck], width)] if status.bottleneck else []
    lessons = [f"{name} {text}" for name, text in status.lessons.items()]
    notes += [_line(["lessons:", *lessons], width)] if lessons else []
    rates = [f"{name} {short_share(rate)}" for name, rate in status.league.win_rates.items()] if status.league else []
    notes += [_line(["newest wins against", *rates], width)] if rates else []
    lines = max(lines - len(notes), 0)
    shown = status.actors[:lines]
    more = status.fleet_size - len(shown)
    parts: list[RenderableType] = [*_head(run, width, ascii_only), *notes]
    if shown:
        parts.append(_actors(shown, width, status.updates_per_batch))
    if more > 0:
        parts.append(_line([f"... and {more:,} more" if shown else f"{more:,} actors"], width, "dim"))
    return parts


def _head(run: WatchedRun, width: int, ascii_only: bool) -> list[RenderableType]:
    status = run.status
    share = min(status.env_steps / max(status.env_steps_budget, 1), 1.0)
    up = f"  up {duration(status.uptime_seconds)}" if width >= _WIDE else ""
    left = "-" if run.seconds_left is None else duration(run.seconds_left)
    label = f"{_strength(status)}  "
    curve = sparkline(run.curve, min(width - len(label) - 1, _SPARKLINE_WIDTH), ASCII if ascii_only else BLOCKS)
    progress = Table.grid(padding=(0, 1))
    progress.add_row(
        ProgressBar(total=1.0, completed=share, width=max(min(width - (40 if up else 24), 40), 5)),
        Text(f"{share:4.0%}  left {left:>6}{up}", no_wrap=True),
    )
    return [
        _line([f"{status.environment}, {status.algorithm}", f"run {status.run}"], width, "bold"),
        progress,
        Text.assemble(label, (curve, "green"), no_wrap=True, overflow="crop"),
        _line(
            [
                f"env_steps {status.env_steps:,}",
                f"{short_rate(status.env_steps_per_second)}/s",
                f"of {status.env_steps_budget:,}",
            ],
            width,
        ),
        _line(
            [
                f"updates {status.updates:,}",
                f"{short_rate(status.updates_per_second)}/s",
                f"lag {policy_lag(status.policy_lag_mean, status.updates_per_batch)}",
                *([f"{status.updates_skipped:,} skipped"] if status.updates_skipped else []),
                f"rollouts {status.rollouts_accepted:,} accepted, {sum(status.rollouts_rejected.values()):,} rejected",
            ],
            width,
        ),
    ]


def _strength(status: RunStatus) -> str:
    """Return the rating of the newest policy with its deviation, or the mean return where there is no rating."""
    if status.league and (newest := status.league.newest):
        return f"rating {newest.text:>14}"
    return f"return {'-' if status.episode_return_mean is None else short_number(status.episode_return_mean):>8}"


def _actors(actors: Sequence[ActorStatus], width: int, updates_per_batch: int) -> Table:
    shown = [name for name, needed in _COLUMNS if width >= needed]
    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="dim")
    for name in shown:
        right = name not in ("actor", "state", "host")
        table.add_column(name, justify="right" if right else "left", no_wrap=True, overflow="ellipsis")
    for actor in actors:
        cells = _cells(actor, updates_per_batch)
        style = "" if cells["state"].plain == "alive" else "dim" if cells["state"].plain == "gone" else "yellow"
        table.add_row(*(cells[name] for name in shown), style=style)
    return table


def _cells(actor: ActorStatus, updates_per_batch: int) -> dict[str, Text]:
    return {
        "actor": Text(one_line(actor.actor)),
        "state": Text("quarantined" if actor.quarantined else "alive" if actor.alive else "gone"),
        "env_steps": Text(f"{actor.env_steps:,}"),
        "/s": Text(short_rate(actor.env_steps_per_second)),
        "lag": Text(policy_lag(actor.policy_lag, updates_per_batch).partition(" (")[0]),
        "busy": Text(f"{actor.busy_share:.0%}"),
        "host": Text(one_line(actor.host)),
    }


def _line(parts: Sequence[str], width: int, style: str = "") -> Text:
    """Return as many of the parts as fit into one line; the first one is cut if it does not fit."""
    shown = [one_line(part) for part in parts]
    while len(shown) > 1 and len("  ".join(shown)) > width:
        shown.pop()
    return Text("  ".join(shown), style=style, no_wrap=True, overflow="ellipsis")
