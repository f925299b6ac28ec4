"""The lag study: the lag is exact, a run is determined by its seed, and an interrupted study goes on."""

import csv
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
LAG = 2
ROLLOUT = 16 * 128  # env_steps of a rollout of CartPole for a3c; the resets of environments count less


def study(folder: Path) -> tuple[list[dict[str, str]], str]:
    """Make what is missing of a small study; return its lines and what it printed."""
    settings = ["--variants", "a3c rollouts", "a3c gradients", "--lags", "0", str(LAG), "--seeds", "1"]
    budget = ["--tasks", "cartpole", "--env-steps", str(5 * ROLLOUT)]
    output = subprocess.run(
        [sys.executable, "-m", "benchmarks.study.lag", "--file", str(folder / "lag.csv"), *settings, *budget],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    with open(folder / "lag.csv", newline="") as file:
        return list(csv.DictReader(file)), output


def test_the_study_of_lag(tmp_path: Path) -> None:
    rows, output = study(tmp_path)
    assert [(row["variant"], row["lag"]) for row in rows] == [
        ("a3c rollouts", "0"),
        ("a3c rollouts", "2"),
        ("a3c gradients", "0"),
        ("a3c gradients", "2"),
    ]
    for row in rows:
        updates = 6  # five whole rollouts are less than the budget, because resets do not count
        lags = [min(update, int(row["lag"])) for update in range(updates)]
        assert float(row["lag_mean"]) == float(f"{sum(lags) / updates:.4g}"), row
    assert "| a3c gradients | 2 | 1.5 |" in output
    lines = (tmp_path / "lag.csv").read_text().splitlines()
    (tmp_path / "lag.csv").write_text("\n".join([lines[0], lines[1], lines[3], lines[4][:20]]))  # cut by a crash
    again, output = study(tmp_path)
    assert output.startswith("1 of 2: ")

    def results(lines: list[dict[str, str]]) -> list[list[str]]:
        return sorted([value for name, value in row.items() if name != "seconds"] for row in lines)

    assert results(again) == results(rows)
