"""Planned runs of CartPole, and directories of runs that have ended."""

import json
from pathlib import Path

from recorded_runs import record

from daedalus.analysis.sweep_plan import PlannedRun, Planner, Point
from daedalus.cli.commands.sweep import parser, train_words, with_point
from daedalus.cli.settings_arguments import resolve_spec
from daedalus.learner.run.run_directory import SUMMARY, read_json, write_config
from daedalus.protocol.spec import RunSpec


def planner(folder: Path, *options: str) -> Planner:
    parsed = parser().parse_args(["cartpole", *options])

    def settings(point: Point, seed: int) -> tuple[RunSpec, list[str]]:
        chosen = with_point(parsed, point, seed)
        return resolve_spec(chosen), train_words(chosen)

    return Planner(folder, settings)


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
