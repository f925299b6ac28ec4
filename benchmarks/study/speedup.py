"""Measure how much sooner more actors reach a reference score: table 2 of Mnih et al. (2016).

    python -m benchmarks.study.speedup --file build/speedup.csv
    python -m benchmarks.study.speedup --file build/speedup.csv --tasks acrobot --methods a3c --seeds 1 2
    python -m benchmarks.study.speedup --file build/simulated.csv --simulated
    python -m benchmarks.study.speedup --file build/speedup.csv --table

1 to 16 actors with one environment each, all on this machine. A step of an environment takes 5 ms, most of it waiting
(--milliseconds), as with robots and slow simulators: 16 actors of fast environments would only wait for the two cores.
Runs with few actors are made side by side, with at most 16 actors at a time. The seconds of a run count from the first
rollouts, without the start of the processes. The score is the mean return of the last 50 training episodes; to be
comparable, all actors of the methods with action values explore with epsilon 0.05 in the end.

With --simulated the actors of a run are in one process and time is simulated: an environment step takes 5 ms, and all
else none. Runs are then a hundred times as fast, and the two cores set no limit to the number of actors.

Each run adds a line to the file; the same command again makes only those that are missing.
"""

import argparse
import csv
import itertools
import json
import math
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.recorded_runs import RecordedRuns
from benchmarks.running import COMMAND, machine, table
from benchmarks.study.simulated_actors import train_simulated
from daedalus.actor.environments.make import make_environments
from daedalus.analysis.comparison import estimate, written
from daedalus.launch.run_choice import RunChoice
from daedalus.learner.run.default_settings import default_settings
from daedalus.protocol.spec import EnvironmentSpec

_IDENTITY = ("task", "method", "actors", "seed", "milliseconds")
_RESULTS = ("seconds", "env_steps")  # until the score was reached; blank if it was not
_ACTORS_AT_ONCE = 16
_RESAMPLES = 10_000
_MODULE = "benchmarks.study.waiting"
# Learning rates are the best of four on CartPole, with 1 and with 16 actors, on seeds 101 to 104.
_POLICY = ("training.learning_rate=7e-4",)
_VALUES = (
    "training.learning_rate=2e-3",
    "training.exploration=[0.05]",
    "training.exploration_env_steps=5000",
    "training.target_period=50",
)


class Task(NamedTuple):
    """An environment with its reference score."""

    id: str
    score: float
    env_steps: int  # budget
    settings: Sequence[str]


TASKS = {
    "cartpole": Task("CartPole-v1", 150.0, 400_000, ("environment.reward_scale=0.05",)),
    "acrobot": Task("Acrobot-v1", -150.0, 400_000, ("environment.reward_scale=0.05",)),
    "frozen_lake": Task("FrozenLake-v1", 0.8, 200_000, ("environment.kwargs.is_slippery=false",)),
}
# By name: algorithm and settings.
METHODS: dict[str, tuple[str, Sequence[str]]] = {
    "a3c": ("a3c", _POLICY),
    "a3c, gradients": ("a3c", (*_POLICY, "collection.upload=gradients")),
    "one_step_q": ("one_step_q", _VALUES),
    "one_step_sarsa": ("one_step_sarsa", _VALUES),
    "n_step_q": ("n_step_q", _VALUES),
}


def changes(run: Mapping[str, Any]) -> list[str]:
    """Return the assignments that make the default settings those of a run."""
    task, (_, settings) = TASKS[run["task"]], METHODS[run["method"]]
    return [
        "collection.envs_per_actor=1",
        "collection.rollout_length=20",
        f"training.target_return={task.score}",
        "training.target_episodes=50",
        *task.settings,
        *settings,
    ]


def simulate(run: Mapping[str, Any]) -> dict[str, Any]:
    """Make a run in simulated time; return its results."""
    task, (algorithm, _) = TASKS[run["task"]], METHODS[run["method"]]
    environments = make_environments(EnvironmentSpec(id=task.id), 1)
    environments.close()
    choice = RunChoice(
        env=task.id,
        algorithm=algorithm,
        seed=run["seed"],
        env_steps=task.env_steps,
        actors=run["actors"],
        assignments=changes(run),
    )
    spec = choice.spec(default_settings(environments.spaces))
    learner, seconds = train_simulated(spec, run["milliseconds"] / 1000)
    if learner.env_steps_to_target is None:
        return {"seconds": "", "env_steps": ""}
    return {"seconds": f"{seconds:.2f}", "env_steps": learner.env_steps_to_target}


def train(run: Mapping[str, Any]) -> dict[str, Any]:
    """Make a run of processes; return its results."""
    assignments = [
        f'environment.kwargs.of="{TASKS[run["task"]].id}"',
        f"environment.kwargs.milliseconds={run['milliseconds']}",
        "service.log_seconds=0.5",
        "evaluation.seconds=100000",
        "evaluation.max_episode_env_steps=1",  # no time is lost on the policy that has reached the score
        "evaluation.final_episodes=1",
        *changes(run),
    ]
    words = [word for assignment in assignments for word in ("--set", assignment)]
    words += ["--algorithm", METHODS[run["method"]][0], "--seed", run["seed"], "--actors", run["actors"]]
    words += ["--env-steps", TASKS[run["task"]].env_steps]
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "run"
        command = [*COMMAND, "train", "--env", f"{_MODULE}:Waiting-v0", *words, "--run-dir", directory]
        finished = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
        if finished.returncode not in (0, 3):
            raise SystemExit(f"a run failed: {run}\n{finished.stdout}{finished.stderr}")
        summary = json.loads((directory / "summary.json").read_text())
        with open(directory / "metrics.csv", newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    if not summary["solved"]:
        return {"seconds": "", "env_steps": ""}
    first = next(row for row in rows if float(row["env_steps"]) > 0)
    before = float(first["wall_seconds"]) - float(first["env_steps"]) / float(first["env_steps_per_second"])
    return {"seconds": f"{summary['seconds_to_target'] - before:.2f}", "env_steps": summary["env_steps"]}


class Places:
    """Bound on the number of actors that play at a time."""

    def __init__(self, count: int) -> None:
        self._free = count
        self._changed = threading.Condition()

    @contextmanager
    def taken(self, count: int) -> Iterator[None]:
        """Wait until so many places are free, and take them."""
        with self._changed:
            self._changed.wait_for(lambda: self._free >= count)
            self._free -= count
        try:
            yield
        finally:
            with self._changed:
                self._free += count
                self._changed.notify_all()


def make(wanted: Sequence[Mapping[str, Any]], runs: RecordedRuns, simulated: bool) -> None:
    """Make runs, those of processes side by side, and add the line of each to the file when it has ended."""
    places, lock = Places(_ACTORS_AT_ONCE), threading.Lock()

    def one(run: Mapping[str, Any]) -> None:
        with places.taken(_ACTORS_AT_ONCE if simulated else run["actors"]):
            line = {**run, **(simulate if simulated else train)(run)}
        with lock:
            runs.add(line)
            print(", ".join(str(value) for value in line.values()), flush=True)

    with ThreadPoolExecutor(_ACTORS_AT_ONCE) as pool:
        for future in [pool.submit(one, run) for run in wanted]:
            future.result()


def results(lines: Sequence[Mapping[str, str]]) -> str:
    """Return a table for each task: how many times sooner than one actor more of them reach the score."""
    texts = []
    for task in dict.fromkeys(line["task"] for line in lines):
        of_task = [line for line in lines if line["task"] == task]
        counts = sorted({int(line["actors"]) for line in of_task} - {1})
        rows = []
        for method in METHODS:
            chosen = [line for line in of_task if line["method"] == method]
            alone, env_steps = (_values(chosen, 1, name) for name in _RESULTS)
            if not len(alone):
                continue
            sooner, shares = [], []
            for count in counts:
                seconds, needed = (_values(chosen, count, name) for name in _RESULTS)
                sooner.append(_ratio(alone, seconds, "{:.1f}") if len(seconds) else "")
                shares.append(_share(needed, env_steps))
            reached = f"{sum(bool(line['seconds']) for line in chosen)} of {len(chosen)}"
            interval = written(estimate([alone]), "{:.1f}".format)
            rows.append((method, interval, *sooner, " / ".join(shares), reached))
        header = ("method", "seconds of 1 actor", *(f"{count}: times sooner" for count in counts))
        texts.append(
            f"{task}, mean return {TASKS[task].score:g}\n\n{table((*header, 'env_steps, relative', 'reached'), rows)}"
        )
    note = "Times sooner and env_steps: ratios of the medians to those of one actor; 95 % bootstrap intervals."
    return "\n\n".join([*texts, note])


def _ratio(above: np.ndarray, below: np.ndarray, form: str) -> str:
    """Return the ratio of two medians with its bootstrap interval; runs that did not reach the score are infinite.

    Return "-" where most runs of one actor did not.
    """
    if math.isinf(np.median(above)):
        return "-"
    random = np.random.default_rng(0)

    def drawn(values: np.ndarray) -> np.ndarray:
        return np.median(random.choice(values, (_RESAMPLES, len(values))), axis=1)

    with np.errstate(invalid="ignore"):  # neither reached the score: no ratio
        ratios = np.nan_to_num(drawn(above) / drawn(below), nan=1.0, posinf=math.inf)
        middle = np.median(above) / np.median(below)
    low, high = np.quantile(ratios, (0.025, 0.975), method="nearest")
    return f"{form.format(middle)} [{form.format(low)}, {form.format(high)}]"


def _share(needed: np.ndarray, alone: np.ndarray) -> str:
    """Return the ratio of two medians of env_steps; "-" where most runs of one actor did not reach the score."""
    if not len(needed) or math.isinf(np.median(alone)):
        return "-"
    return f"{np.median(needed) / np.median(alone):.2f}"


def _values(lines: Sequence[Mapping[str, str]], actors: int, name: str) -> np.ndarray:
    """Return a result of the runs with so many actors, [runs], by seed; infinite if the score was not reached."""
    chosen = sorted((line for line in lines if int(line["actors"]) == actors), key=lambda line: int(line["seed"]))
    return np.array([float(line[name] or math.inf) for line in chosen])


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--file", type=Path, required=True, help="CSV file of the runs")
    options.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    options.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    options.add_argument("--actors", nargs="+", type=int, default=[16, 8, 4, 2, 1])
    options.add_argument("--seeds", nargs="+", type=int, default=list(range(11, 21)))
    options.add_argument("--milliseconds", type=float, default=5.0, help="duration of an environment step")
    options.add_argument("--simulated", action="store_true", help="simulate the time: one process, one run at a time")
    options.add_argument("--table", action="store_true", help="only print the tables of the runs so far")
    parsed = options.parse_args()
    runs = RecordedRuns(parsed.file, _IDENTITY, _RESULTS)
    wanted: list[Mapping[str, Any]] = [
        dict(zip(_IDENTITY, (task, method, actors, seed, parsed.milliseconds), strict=True))
        for seed, actors, task, method in itertools.product(parsed.seeds, parsed.actors, parsed.tasks, parsed.methods)
    ]
    if not parsed.table:
        make(runs.missing(wanted), runs, parsed.simulated)
    print(machine())
    print(results(runs.read()))


if __name__ == "__main__":
    main()
