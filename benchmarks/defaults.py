"""Train environments that nobody tuned, with our defaults and with those of stable-baselines3's PPO.

    pip install -e ".[benchmark,box2d,mujoco,minigrid]"
    python -m benchmarks.defaults --file build/defaults.csv
    python -m benchmarks.defaults --file build/defaults.csv --only LunarLander-v3 Pendulum-v1 --seeds 11 12 13
    python -m benchmarks.defaults --file benchmarks/measured/defaults.csv --table

Ours is `daedalus train --env ID` (MemoryS7 with `policy.memory=gru`), theirs PPO with all defaults and 8 environments
in one process (MultiInputPolicy for Dict observations, CnnPolicy for images; it has no memory). Both get the same
env_steps and the same seeds. The score of a run is the mean return of its last 100 training episodes, with sampled
actions; its seconds are those of training alone, its CPU seconds those of all its processes. Each run adds a line to
the file; the same command again makes only those that are missing.

The table gives interquartile means over the seeds with 95 % bootstrap intervals, and the probability that a run of ours
is better than one of theirs.
"""

import argparse
import json
import resource
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.recorded_runs import RecordedRuns
from benchmarks.running import machine, table, train
from daedalus.analysis.comparison import estimate, improvement, written

_PEER = Path(__file__).parent / "peer.py"
_IDENTITY, _RESULTS = ("environment", "env_steps", "seed", "trainer"), ("score", "seconds", "cpu_seconds")


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """An environment of the basket."""

    id: str
    env_steps: int
    kwargs: tuple[tuple[str, Any], ...] = ()  # of gymnasium.make
    settings: tuple[str, ...] = ()  # of ours, where the task cannot be learnt without them

    @property
    def name(self) -> str:
        """The id with its keywords."""
        return " ".join([self.id, *(f"{key}={value}" for key, value in self.kwargs)])


BASKET = (
    Task(id="CartPole-v1", env_steps=200_000),
    Task(id="Acrobot-v1", env_steps=300_000),
    Task(id="LunarLander-v3", env_steps=500_000),
    Task(id="LunarLander-v3", env_steps=500_000, kwargs=(("continuous", True),)),
    Task(id="MountainCarContinuous-v0", env_steps=100_000),
    Task(id="Pendulum-v1", env_steps=200_000),
    Task(id="BipedalWalker-v3", env_steps=500_000),
    Task(id="Taxi-v4", env_steps=300_000),
    Task(id="FrozenLake-v1", env_steps=100_000, kwargs=(("is_slippery", False),)),
    Task(id="FrozenLake-v1", env_steps=300_000),
    Task(id="InvertedPendulum-v5", env_steps=100_000),
    Task(id="Hopper-v5", env_steps=500_000),
    Task(id="Walker2d-v5", env_steps=500_000),
    Task(id="HalfCheetah-v5", env_steps=500_000),
    Task(id="Ant-v5", env_steps=500_000),
    Task(id="minigrid:MiniGrid-DoorKey-5x5-v0", env_steps=200_000),
    Task(id="minigrid:MiniGrid-MemoryS7-v0", env_steps=1_000_000, settings=("policy.memory=gru",)),
    Task(id="ALE/Pong-v5", env_steps=20_000),  # few, because PPO learns from whole pictures: minutes
)


def ours(task: Task, seed: int) -> tuple[float, float]:
    """Train with `daedalus train --env`, as a user would; return score and seconds."""
    kwargs = [word for key, value in task.kwargs for word in ("--set", f"environment.kwargs.{key}={json.dumps(value)}")]
    settings = [word for setting in (*task.settings, "evaluation.final_episodes=1") for word in ("--set", setting)]
    summary = train("--env", task.id, "--seed", seed, "--env-steps", task.env_steps, *kwargs, *settings)
    return summary["episode_return_mean"], summary["wall_seconds"]


def ppo(task: Task, seed: int) -> tuple[float, float]:
    """Train with stable-baselines3's PPO, in a process of its own; return score and seconds."""
    command = [sys.executable, str(_PEER), "--env", task.id, "--env-steps", str(task.env_steps), "--seed", str(seed)]
    command += ["--kwargs", json.dumps(dict(task.kwargs))]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        raise SystemExit(f"PPO on {task.name} failed:\n{finished.stderr}")
    result = json.loads(finished.stdout.splitlines()[-1])
    return result["score"], result["seconds"]


_TRAINERS = {"ours": ours, "ppo": ppo}


def _cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def measure(runs: RecordedRuns, tasks: Sequence[Task], seeds: Sequence[int], trainers: Sequence[str]) -> None:
    """Make the runs that the file lacks: all tasks with the first seed, then with the next."""
    for seed in seeds:
        for task in tasks:
            wanted = [
                {"environment": task.name, "env_steps": task.env_steps, "seed": seed, "trainer": trainer}
                for trainer in trainers
            ]
            for run in runs.missing(wanted):
                before = _cpu_seconds()
                score, seconds = _TRAINERS[run["trainer"]](task, seed)
                results = {"seconds": f"{seconds:.1f}", "cpu_seconds": f"{_cpu_seconds() - before:.1f}"}
                line = {**run, "score": f"{score:.6g}", **results}
                runs.add(line)
                print(", ".join(str(value) for value in line.values()), flush=True)


def results(runs: RecordedRuns, tasks: Sequence[Task]) -> str:
    """Return the table of the runs so far."""
    lines, rows = runs.read(), []
    for task in tasks:
        chosen = {
            trainer: sorted(
                (int(line["seed"]), line)
                for line in lines
                if (line["environment"], line["env_steps"], line["trainer"])
                == (task.name, str(task.env_steps), trainer)
            )
            for trainer in _TRAINERS
        }
        columns = {
            (trainer, column): np.array([float(line[column]) for _, line in found])
            for trainer, found in chosen.items()
            for column in _RESULTS
        }
        row: list[object] = [task.name, f"{task.env_steps:,}"]
        for trainer in _TRAINERS:
            scores = columns[trainer, "score"]
            row += [written(estimate([scores]), "{:.4g}".format) if len(scores) else "", len(scores)]
        both = all(chosen.values())
        scores = [columns[trainer, "score"] for trainer in _TRAINERS]
        row.append(written(improvement(scores[:1], scores[1:]), "{:.2f}".format) if both else "")
        for column in ("seconds", "cpu_seconds"):
            mine, other = (columns[trainer, column] for trainer in _TRAINERS)
            row.append(f"{statistics.median(other) / statistics.median(mine):.1f}" if both else "")
        rows.append(row)
    header = ("environment", "env_steps", "ours", "runs", "PPO", "runs", "P(ours > PPO)", "seconds", "CPU seconds")
    return table(header, rows) + "\n\nseconds, CPU seconds: PPO's median by ours."


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--file", type=Path, required=True, help="CSV file of the runs")
    options.add_argument("--only", nargs="+", metavar="ID", help="environments of the basket, by id (default: all)")
    options.add_argument("--seeds", nargs="+", type=int, default=[11, 12, 13, 14, 15])
    options.add_argument("--trainers", nargs="+", choices=_TRAINERS, default=list(_TRAINERS))
    options.add_argument("--table", action="store_true", help="only print the table of the runs so far")
    parsed = options.parse_args()
    unknown = set(parsed.only or ()) - {task.id for task in BASKET}
    if unknown:
        options.error(f"not in the basket: {', '.join(sorted(unknown))}")
    tasks = [task for task in BASKET if not parsed.only or task.id in parsed.only]
    runs = RecordedRuns(parsed.file, _IDENTITY, _RESULTS)
    if not parsed.table:
        measure(runs, tasks, parsed.seeds, parsed.trainers)
    print(machine())
    print(results(runs, tasks))


if __name__ == "__main__":
    main()
