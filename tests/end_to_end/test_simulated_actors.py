"""Several actors in simulated time: their lag and their speed are those of processes that play side by side."""

import importlib
from pathlib import Path
from typing import Any

import pytest

from daedalus.learner.run.settings import run_spec

ROLLOUT = 20
SECONDS = 0.005  # of a step


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


def trained(actors: int, upload: str, env_steps: int) -> tuple[Any, float]:
    """Return the learner and the simulated seconds."""
    settings = {
        "environment": {"id": "CartPole-v1"},
        "collection": {"actors": actors, "envs_per_actor": 1, "rollout_length": ROLLOUT, "upload": upload},
        "training": {"algorithm": "a3c", "seed": 1, "env_steps": env_steps},
    }
    return importlib.import_module("benchmarks.study.simulated_actors").train_simulated(run_spec(settings), SECONDS)


@pytest.mark.parametrize("upload", ["rollouts", "gradients"])
def test_actors_lag_by_the_updates_of_the_others_and_play_at_the_same_time(upload: str) -> None:
    seconds = {}
    for actors in (1, 4):
        learner, seconds[actors] = trained(actors, upload, 4000)
        counters = learner.counters
        assert counters.policy_lag_mean == pytest.approx(actors - 1, abs=0.2)
        rollouts = counters.rollouts_trained
        assert seconds[actors] == pytest.approx(rollouts * ROLLOUT * SECONDS / actors, rel=0.05)
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
