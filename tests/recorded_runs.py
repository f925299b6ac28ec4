"""Run directories as finished runs leave them, with results of our choice, and without training."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.metrics_rows import Details, league_columns
from daedalus.learner.run.run_directory import METRICS, create
from daedalus.learner.run.settings import override, read_preset, run_spec
from daedalus.protocol.league import LeagueStatus

TARGET = 475.0  # of the preset


def record(
    directory: Path,
    *,
    seed: int = 1,
    settings: Sequence[str] = (),
    returns: Sequence[float | None] = (100.0, 300.0, 480.0),
    env_steps: Sequence[int] = (1000, 2000, 3000),
    evaluation: float | None = 490.0,
    finished: bool = True,
    preset: str = "cartpole",
    evaluations: Mapping[int, float] = MappingProxyType({}),
    league: LeagueStatus | None = None,
    **summary: Any,
) -> Path:
    """Write the directory of a run with one row of metrics for each of `returns`, one minute apart.

    `evaluations` has mean returns of evaluations by the index of their row; `league` has all ratings and results.
    """
    values = read_preset(preset)
    values.pop("for_algorithm", None)
    override(values, [f"training.seed={seed}", *settings])
    create(directory, run_spec(values))
    writer = CsvWriter(directory / METRICS)
    for minute, (mean, steps) in enumerate(zip(returns, env_steps, strict=True), start=1):
        row: dict[str, float] = {"wall_seconds": 60.0 * minute, "env_steps": steps, "episodes": steps / 10}
        row |= {"entropy": 1.0, "value_loss": 2.0, "policy_lag_mean": 0.5}
        row |= {} if league is None else league_columns(league)
        if mean is not None:
            row |= {"episode_return_mean": mean, "episode_return_std": 5.0}
        if minute - 1 in evaluations:  # begun 50 env_steps before its result
            row |= {"evaluation_return_mean": evaluations[minute - 1], "evaluation_env_steps": steps - 50}
        writer.write(row, Details())
    writer.close()
    result = {"finished": finished, "env_steps": env_steps[-1], "solved": False, "seconds_to_target": None}
    content = {**result, "evaluation_return_mean": evaluation, **summary}
    if league is not None:
        content["league"] = league.model_dump(mode="json")
    if finished or evaluation is not None:
        (directory / "summary.json").write_text(json.dumps(content))
    return directory
