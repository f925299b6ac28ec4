"""Study what policy lag costs: final return and env_steps to a threshold, when snapshots reach the actors late.

    python -m benchmarks.study.lag --file build/lag.csv
    python -m benchmarks.study.lag --file build/lag.csv --tasks catch --lags 0 16 --seeds 5 --jobs 4

Every rollout is played with weights of exactly so many updates ago, in one process, so that a run is determined by its
seed. Each run adds a line to the file; the same command again makes only the runs that are missing. At the
end, and with --table alone, the table is printed from the file: interquartile means and 95 % bootstrap intervals.
"""

import argparse
import itertools
import math
import multiprocessing
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.recorded_runs import RecordedRuns
from benchmarks.running import machine, table
from benchmarks.study.tasks import TASKS, VARIANTS, specification
from daedalus.analysis.comparison import estimate, improvement, written
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spec import RunSpec

if TYPE_CHECKING:
    from benchmarks.study.one_process import LocalLearner

_IDENTITY = ("task", "variant", "lag", "seed", "budget")
_RESULTS = ("env_steps", "final_return", "env_steps_to_threshold", "lag_mean", "seconds")


@dataclass(frozen=True, slots=True)
class Cell:
    """A run of the study."""

    task: str
    variant: str
    lag: int
    seed: int
    budget: int  # env_steps


def run(cell: Cell) -> dict[str, Any]:
    """Make a run; return its line of the file."""
    from daedalus.learner.run.process_resources import keep_freed_memory

    keep_freed_memory()
    began = time.monotonic()
    learner = _train(specification(cell.task, cell.variant, cell.seed, cell.budget), cell.lag)
    counters = learner.counters
    return {
        **asdict(cell),
        "env_steps": counters.env_steps,
        "final_return": "" if counters.episode_return_mean is None else f"{counters.episode_return_mean:.6g}",
        "env_steps_to_threshold": learner.env_steps_to_target or "",
        "lag_mean": f"{counters.policy_lag_mean:.4g}",
        "seconds": f"{time.monotonic() - began:.1f}",
    }


def _train(spec: RunSpec, lag: int) -> "LocalLearner":
    """Train with one rollout for each batch, until the end of the run; return the learner.

    Args:
      spec: settings of the run.
      lag: updates by which snapshots arrive late. Where a batch makes several updates, snapshots are at least so late.
    """
    from benchmarks.study.one_process import LocalActor, LocalLearner

    actor = LocalActor(spec, "actor-0")
    try:
        learner = LocalLearner(spec, actor.spaces)
        actor.begin(learner.program, spec.training.seed)
        snapshots: deque[Snapshot] = deque()
        while not learner.ended:
            snapshots.append(learner.snapshot())
            while len(snapshots) > 1 and snapshots[1].policy_version <= learner.policy_version - lag:
                snapshots.popleft()
            learner.train(actor.play(snapshots[0]))
    finally:
        actor.close()
    return learner


def cell(line: Mapping[str, str]) -> Cell:
    """Return the run of a line of the file."""
    return Cell(line["task"], line["variant"], int(line["lag"]), int(line["seed"]), int(line["budget"]))


def make(cells: Sequence[Cell], runs: RecordedRuns, jobs: int) -> None:
    """Make runs, and add the line of each to the file when it has ended."""
    for number, row in enumerate(_results(cells, jobs), start=1):
        runs.add(row)
        shown = ", ".join(f"{name} {row[name]}" for name in _IDENTITY)
        print(f"{number} of {len(cells)}: {shown}: return {row['final_return']}, {row['seconds']} s", flush=True)


def _results(cells: Sequence[Cell], jobs: int) -> Iterable[dict[str, Any]]:
    if jobs == 1:
        yield from map(run, cells)
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run, cell) for cell in cells]):
            yield future.result()


def tables(rows: dict[Cell, dict[str, str]]) -> str:
    """Return the tables of the study: one for each task, and one of all tasks together."""
    texts = []
    for task in dict.fromkeys(cell.task for cell in rows):
        lines = []
        for variant, lag in _settings(rows, task):
            returns = _values(rows, task, variant, lag, "final_return")
            steps = np.nan_to_num(_values(rows, task, variant, lag, "env_steps_to_threshold"), nan=math.inf)
            mean_lag = np.mean(_values(rows, task, variant, lag, "lag_mean"))
            reached = f"{np.isfinite(steps).sum()} of {len(steps)}"
            final = written(estimate([returns]), "{:.4g}".format)
            lines.append(
                (variant, lag, f"{mean_lag:.1f}", final, reached, written(estimate([steps]), "{:,.0f}".format))
            )
        header = (
            "variant",
            "lag, updates",
            "measured",
            "final return",
            "reached",
            f"env_steps to {TASKS[task].threshold:g}",
        )
        texts.append(f"{task}\n\n{table(header, lines)}")
    return "\n\n".join([*texts, _together(rows)])


def _settings(rows: Iterable[Cell], task: str | None = None) -> list[tuple[str, int]]:
    """Return the variants and lags that have runs, in the order of VARIANTS."""
    found = {(cell.variant, cell.lag) for cell in rows if task in (None, cell.task)}
    return sorted(found, key=lambda setting: (list(VARIANTS).index(setting[0]), setting[1]))


def _values(rows: dict[Cell, dict[str, str]], task: str, variant: str, lag: int, column: str) -> np.ndarray:
    """Return a column of the runs of a setting, [runs], ordered by seed; NaN: blank."""
    chosen = sorted(
        (cell.seed, row) for cell, row in rows.items() if (cell.task, cell.variant, cell.lag) == (task, variant, lag)
    )
    return np.array([float(row[column] or "nan") for _, row in chosen])


def _together(rows: dict[Cell, dict[str, str]]) -> str:
    """Return the table over all tasks, with returns normalised: 0 a random policy, 1 the threshold of the task.

    Each task has a column beside the pool: a middle half of all runs may leave out a task that is not learnt.
    """
    tasks = list(dict.fromkeys(cell.task for cell in rows))
    lines = []
    for variant, lag in _settings(rows):
        strata, without = (_normalised(rows, tasks, variant, each) for each in (lag, 0))
        if not all(map(len, strata)):  # a task lacks this setting so far
            continue
        better = ""
        if lag and all(map(len, without)):
            better = written(improvement(strata, without), "{:.2f}".format)
        each = [written(estimate([scores]), "{:.2f}".format) for scores in strata]
        lines.append((variant, lag, written(estimate(strata), "{:.3f}".format), *each, better))
    header = ("variant", "lag, updates", "all", *tasks, "P(> lag 0)")
    return f"{', '.join(tasks)} together (0: random policy, 1: threshold)\n\n{table(header, lines)}"


def _normalised(rows: dict[Cell, dict[str, str]], tasks: Sequence[str], variant: str, lag: int) -> list[np.ndarray]:
    return [
        (_values(rows, name, variant, lag, "final_return") - TASKS[name].random_return)
        / (TASKS[name].threshold - TASKS[name].random_return)
        for name in tasks
    ]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--file", type=Path, required=True, help="CSV file of the runs")
    options.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    options.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    options.add_argument("--lags", nargs="+", type=int, default=[0, 1, 4, 16, 64])
    options.add_argument("--seeds", type=int, default=10, help="number of seeds")
    options.add_argument("--jobs", type=int, default=1, help="runs side by side")
    options.add_argument("--env-steps", type=int, help="budget of each run (default: that of the task)")
    options.add_argument("--table", action="store_true", help="only print the tables of the runs so far")
    parsed = options.parse_args()
    budgets = {name: parsed.env_steps or task.env_steps for name, task in TASKS.items()}
    # All settings with the first seed, then with the next: the tables make sense at any time.
    cells = [
        Cell(task, variant, lag, seed, budgets[task])
        for seed in range(1, parsed.seeds + 1)
        for task, variant, lag in itertools.product(parsed.tasks, parsed.variants, parsed.lags)
    ]
    runs = RecordedRuns(parsed.file, _IDENTITY, _RESULTS)
    if not parsed.table:
        done = {cell(line) for line in runs.read()}
        make([each for each in cells if each not in done], runs, parsed.jobs)
    lines = {cell(line): line for line in runs.read()}
    print(machine())
    print(tables({each: line for each, line in lines.items() if each.budget == budgets[each.task]}))


if __name__ == "__main__":
    main()
