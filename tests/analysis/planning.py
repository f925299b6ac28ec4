"""Planned runs of CartPole, and directories of runs that have ended."""

import json
from pathlib import Path

from recorded_runs import record

from daedalus.analysis.sweep_plan import PlannedRun, Planner
from daedalus.cli.commands.sweep import parser
from daedalus.cli.settings_arguments import run_choice
from daedalus.learner.run.run_directory import SUMMARY, read_json, write_config


def planner(folder: Path, *options: str) -> Planner:
    parsed = parser().parse_args(["cartpole", *options])
    return Planner(run_choice(parsed), parsed.log, folder)


def finish(run: PlannedRun, *, evaluation: float = 490.0, solved: bool = False, env_steps: int = 3000) -> None:
    """Write what `daedalus train` leaves when a run has ended and was evaluated."""
    record(
        run.directory,
        seed=run.seed,
        evaluation=evaluation,
        env_steps=(1000, 2000, env_steps),
        solved=solved,
        wall_seconds=9.0,
        seconds_to_target=9.0 if solved else None,
        episode_return_mean=480.0 if solved else 100.0,
    )
    write_config(run.directory, run.spec)
    summary = read_json(run.directory / SUMMARY)
    (run.directory / SUMMARY).write_text(json.dumps({**summary, "evaluation": {"episodes": 100}}))
