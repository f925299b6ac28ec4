"""Results of a sweep: tables for the terminal and as CSV, and a picture of the curves."""

import csv
from collections.abc import Sequence
from pathlib import Path

from daedalus.cli.comparing.comparison import compare_groups, final_returns
from daedalus.cli.comparing.drawing import COLUMNS, INSTALL, draw_curves
from daedalus.cli.comparing.grouping import Group, short
from daedalus.cli.comparing.recorded_run import ENV_STEPS, SECONDS, read_run
from daedalus.cli.comparing.selection import select
from daedalus.cli.comparing.statistics import interquartile_mean
from daedalus.cli.comparing.tables import as_csv, as_text
from daedalus.cli.sweeping.plan import PlannedRun
from daedalus.cli.sweeping.sweep import SweepEnd
from daedalus.learner.run.run_files import RunDataError
from daedalus.policy.saving.regular_files import replacing
from daedalus.protocol.texts import one_line

TABLE, RUNS, CURVES = "table.csv", "runs.csv", "curves.png"


def report(folder: Path, planned: Sequence[PlannedRun], end: SweepEnd, keys: Sequence[str], *, ranked: bool) -> str:
    """Write table.csv, runs.csv and curves.png, and return the text for the terminal.

    Args:
      folder: folder of the sweep.
      planned: all runs, with those that failed.
      end: which of them ended how.
      keys: settings that the sweep varies.
      ranked: sort the settings by their final return, best first, and not by their values.

    Raises OSError, RunDataError if no run can be used.
    """
    _write_runs(folder / RUNS, planned, end, keys)
    directories = [run.directory for run in planned if run in end.done]
    if not directories:
        return _failures(end)
    groups, problems = select([directories], finished=True, columns=[SECONDS, *COLUMNS], keys=keys)
    if ranked:
        groups.sort(key=_final_return, reverse=True)
    comparison = compare_groups(groups)
    with replacing(folder / TABLE) as beside:
        beside.write_bytes(as_csv(comparison).encode())  # with the ends of lines that it has
    lines = ["", as_text(comparison), *problems]
    try:
        draw_curves(groups, folder / CURVES, ENV_STEPS)
        written = f"{folder}: {TABLE}, {RUNS}, {CURVES} and the run directories"
    except ModuleNotFoundError:
        written = f"{folder}: {TABLE}, {RUNS} and the run directories; no picture: {INSTALL}"
    return "\n".join([*lines, written, *([_failures(end)] if end.failed else [])])


def _final_return(group: Group) -> float:
    return float(interquartile_mean(final_returns(group, evaluated=True)))


def _failures(end: SweepEnd) -> str:
    names = ", ".join(end.failed)
    return f"failed: {len(end.failed)} ({names}); the same command tries them again"


def _write_runs(path: Path, planned: Sequence[PlannedRun], end: SweepEnd, keys: Sequence[str]) -> None:
    """Write one line for each run."""
    with replacing(path) as beside, open(beside, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        results = ("state", "final_return", "env_steps", "minutes", "reached_target")
        writer.writerow(["run", *(short(key, keys) for key in keys), "seed", *results])
        for run in planned:
            values = [run.point[key] for key in keys]
            writer.writerow([run.name, *values, run.seed, *_result(run, end)])


def _result(run: PlannedRun, end: SweepEnd) -> list[object]:
    if run.name in end.failed:
        return [one_line(f"failed: {end.failed[run.name]}"), "", "", "", ""]
    try:
        recorded = read_run(run.directory, [SECONDS])
    except RunDataError as error:
        return [str(error), "", "", "", ""]
    summary = recorded.summary
    minutes = summary.get("wall_seconds", 0.0) / 60.0
    return ["done", recorded.evaluation, summary.get("env_steps"), minutes, summary.get("solved")]
