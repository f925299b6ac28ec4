"""The studies: the lag is exact, a run repeats, and actors in simulated time are as fast as processes."""

import csv
import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from daedalus.learner.run.settings import run_spec

ROOT = Path(__file__).parents[2]
LAG = 2
ROLLOUT = 16 * 128  # env_steps of a rollout of CartPole for a3c; the resets of environments count less


def words(folder: Path) -> list[str]:
    """Return the command line of a small study."""
    settings = ["--variants", "a3c rollouts", "a3c gradients", "--lags", "0", str(LAG), "--seeds", "1"]
    budget = ["--tasks", "cartpole", "--env-steps", str(5 * ROLLOUT)]
    return ["benchmarks.study.lag", "--file", str(folder / "lag.csv"), *settings, *budget]


def read(folder: Path) -> list[dict[str, str]]:
    with open(folder / "lag.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_the_study_of_lag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    command = [sys.executable, "-m", *words(tmp_path)]
    output = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    rows = read(tmp_path)
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
    monkeypatch.setattr(sys, "argv", words(tmp_path))
    importlib.import_module("benchmarks.study.lag").main()  # in this process, to the same results
    assert capsys.readouterr().out.startswith("1 of 2: ")

    def results(lines: list[dict[str, str]]) -> list[list[str]]:
        return sorted([value for name, value in row.items() if name != "seconds"] for row in lines)

    assert results(read(tmp_path)) == results(rows)


ROWS = 20
SECONDS = 0.005  # of a step


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


def trained(actors: int, upload: str, env_steps: int) -> tuple[Any, float]:
    """Return the learner and the simulated seconds."""
    settings = {
        "environment": {"id": "CartPole-v1"},
        "collection": {"actors": actors, "envs_per_actor": 1, "rollout_length": ROWS, "upload": upload},
        "training": {"algorithm": "a3c", "seed": 1, "env_steps": env_steps},
    }
    return importlib.import_module("benchmarks.study.simulated_actors").train_simulated(run_spec(settings), SECONDS)


@pytest.mark.parametrize("upload", ["rollouts", "gradients"])
def test_actors_lag_by_the_updates_of_the_others_and_play_at_the_same_time(upload: str) -> None:
    seconds = {}
    for actors in (1, 4):
        learner, seconds[actors] = trained(actors, upload, 2000)
        counters = learner.counters
        assert counters.policy_lag_mean == pytest.approx(actors - 1, abs=0.2)
        rollouts = counters.rollouts_trained
        assert seconds[actors] == pytest.approx(rollouts * ROWS * SECONDS / actors, rel=0.05)
    assert seconds[1] / seconds[4] == pytest.approx(4, rel=0.1)


def test_the_running_returns_of_each_actor_go_on_from_rollout_to_rollout(monkeypatch: pytest.MonkeyPatch) -> None:
    one_process = importlib.import_module("benchmarks.study.one_process")
    train, sequences = one_process.LocalLearner.train, {}

    def recording(learner: Any, upload: Any) -> None:
        sequences.setdefault(upload.identity.actor, []).append(upload.identity.sequence)
        train(learner, upload)

    monkeypatch.setattr(one_process.LocalLearner, "train", recording)
    trained(3, "rollouts", 1000)
    assert sorted(sequences) == ["actor-0", "actor-1", "actor-2"]
    assert all(numbers == list(range(len(numbers))) for numbers in sequences.values())


def test_a_run_repeats() -> None:
    first, again = (trained(3, "rollouts", 1000) for _ in range(2))
    assert first[1] == again[1]
    weights = zip(first[0].snapshot().weights.items(), again[0].snapshot().weights.items(), strict=True)
    assert all(name == other and (array == same).all() for (name, array), (other, same) in weights)
