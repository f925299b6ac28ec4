"""Train environments that nobody tuned, with our defaults and with those of stable-baselines3's PPO.

    pip install -e ".[benchmark]"
    python benchmarks/defaults.py
    python benchmarks/defaults.py --only LunarLander-v3 Pendulum-v1 --seeds 11 12 13

Ours is `daedalus train --env ID`, theirs PPO with all defaults and 8 environments in one process (MultiInputPolicy for
Dict observations, CnnPolicy for images). Both get the same env_steps and the same seeds. The score of a run is the mean
return of its last 100 training episodes, with sampled actions; its seconds are those of training alone. An interval is
the standard error of the mean over the seeds, times 2.
"""

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from running import machine, table, train

_PEER = Path(__file__).parent / "peer_ppo.py"


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """An environment of the basket."""

    id: str
    env_steps: int
    kwargs: tuple[tuple[str, Any], ...] = ()  # of gymnasium.make

    @property
    def name(self) -> str:
        """The id with its keywords."""
        return " ".join([self.id, *(f"{key}={value}" for key, value in self.kwargs)])


BASKET = (
    Task(id="CartPole-v1", env_steps=200_000),
    Task(id="Acrobot-v1", env_steps=300_000),
    Task(id="LunarLander-v3", env_steps=500_000),
    Task(id="LunarLander-v3", env_steps=500_000, kwargs=(("continuous", True),)),
    Task(id="MountainCarContinuous-v0", env_steps=300_000),
    Task(id="Pendulum-v1", env_steps=300_000),
    Task(id="BipedalWalker-v3", env_steps=1_000_000),
    Task(id="Taxi-v4", env_steps=500_000),
    Task(id="FrozenLake-v1", env_steps=200_000, kwargs=(("is_slippery", False),)),
    Task(id="FrozenLake-v1", env_steps=500_000),
    Task(id="InvertedPendulum-v5", env_steps=300_000),
    Task(id="Hopper-v5", env_steps=1_000_000),
    Task(id="Walker2d-v5", env_steps=1_000_000),
    Task(id="HalfCheetah-v5", env_steps=1_000_000),
    Task(id="Ant-v5", env_steps=1_000_000),
    Task(id="minigrid:MiniGrid-DoorKey-5x5-v0", env_steps=500_000),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Result of one training."""

    score: float
    seconds: float


def ours(task: Task, seed: int) -> Run:
    """Train with `daedalus train --env`, as a user would."""
    kwargs = [word for key, value in task.kwargs for word in ("--set", f"environment.kwargs.{key}={json.dumps(value)}")]
    few = ("--set", "evaluation.final_episodes=1")
    summary = train("--env", task.id, "--seed", seed, "--env-steps", task.env_steps, *kwargs, *few)
    return Run(score=summary["episode_return_mean"], seconds=summary["wall_seconds"])


def theirs(task: Task, seed: int) -> Run:
    """Train with stable-baselines3's PPO, in a process of its own."""
    command = [sys.executable, str(_PEER), "--env", task.id, "--env-steps", str(task.env_steps), "--seed", str(seed)]
    command += ["--kwargs", json.dumps(dict(task.kwargs))]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        raise SystemExit(f"PPO on {task.name} failed:\n{finished.stderr}")
    return Run(**json.loads(finished.stdout.splitlines()[-1]))


def _interval(values: Sequence[float]) -> str:
    if len(values) < 2:
        return f"{values[0]:.4g}"
    return f"{statistics.fmean(values):.4g} +- {2 * statistics.stdev(values) / len(values) ** 0.5:.3g}"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--only", nargs="+", metavar="ID", help="environments of the basket, by id (default: all)")
    options.add_argument("--seeds", nargs="+", type=int, default=[11, 12, 13, 14, 15])
    options.add_argument("--without-peer", action="store_true", help="train with ours only")
    parsed = options.parse_args()
    unknown = set(parsed.only or ()) - {task.id for task in BASKET}
    if unknown:
        options.error(f"not in the basket: {', '.join(sorted(unknown))}")
    print(machine(), flush=True)
    rows = []
    for task in BASKET:
        if parsed.only and task.id not in parsed.only:
            continue
        runs = [ours(task, seed) for seed in parsed.seeds]
        others = [] if parsed.without_peer else [theirs(task, seed) for seed in parsed.seeds]
        seconds = statistics.fmean(run.seconds for run in runs)
        row: list[object] = [task.name, f"{task.env_steps:,}", _interval([run.score for run in runs]), f"{seconds:.0f}"]
        if others:
            slower = statistics.fmean(run.seconds for run in others)
            row += [_interval([run.score for run in others]), f"{slower:.0f}", f"{slower / seconds:.1f}"]
        rows.append(row)
        print(row, flush=True)
    header = ["environment", "env_steps", "return", "seconds"]
    print(table(header if parsed.without_peer else [*header, "PPO's return", "seconds", "ratio"], rows))


if __name__ == "__main__":
    main()
