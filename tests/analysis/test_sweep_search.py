"""Test of analysis/sweep_search.py."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from planning import finish, planner

from daedalus.analysis.sweep_plan import Choices, PlannedRun, Range
from daedalus.analysis.sweep_search import TRIALS, GridSearch, SampledSearch, Search, score
from daedalus.learner.run.settings import SettingsError

RATES = Range(key="training.learning_rate", low=1e-4, high=1e-1, whole=False)
HIDDEN = Choices(key="policy.hidden", values=("[16]", "[16,16]"))


def make_runs(search: Search, result: Callable[[PlannedRun], float], most: int = 1000) -> list[PlannedRun]:
    """Take and finish up to `most` runs; return them."""
    made = []
    while len(made) < most and (run := search.take()) is not None:
        finish(run, evaluation=result(run))
        search.ended(run, failed=False)
        made.append(run)
    return made


def test_a_grid_has_all_combinations_seed_by_seed(tmp_path: Path) -> None:
    axes = [
        Choices(key="collection.rollout_length", values=("5", "20")),
        Choices(key="training.learning_rate", values=("1e-3", "1e-2")),
    ]
    search = GridSearch(planner(tmp_path), axes, [7, 8])
    runs = []
    while (run := search.take()) is not None:
        runs.append((run.seed, run.spec.collection.rollout_length, run.spec.training.learning_rate))
    grid = [(5, 1e-3), (5, 1e-2), (20, 1e-3), (20, 1e-2)]
    assert runs == [(seed, *point) for seed in (7, 8) for point in grid]
    assert search.total == len(search.planned) == 8


def test_a_sweep_over_nothing_is_its_seeds(tmp_path: Path) -> None:
    assert [run.name for run in GridSearch(planner(tmp_path), [], [1, 2]).planned] == ["seed-1", "seed-2"]


class TestScore:
    def run(self, folder: Path, *options: str, evaluation: float, solved: bool = False, env_steps: int = 3000) -> float:
        (run,) = planner(folder, *options).runs("", {}, [1])
        finish(run, evaluation=evaluation, solved=solved, env_steps=env_steps)
        return score(run)

    def test_runs_that_stop_at_a_target_are_ranked_by_their_env_steps(self, tmp_path: Path) -> None:
        fast = self.run(tmp_path / "fast", evaluation=480.0, solved=True, env_steps=300_000)
        slow = self.run(tmp_path / "slow", evaluation=500.0, solved=True, env_steps=1_200_000)
        missed = self.run(tmp_path / "missed", evaluation=470.0)
        assert (fast, slow) == (pytest.approx(0.8), pytest.approx(0.2))
        assert missed == pytest.approx((100.0 - 475.0) / 475.0)  # by the mean of the training episodes

    def test_a_missed_target_is_ranked_by_the_evaluation_where_training_plays_another_task(
        self, tmp_path: Path
    ) -> None:
        limit = ("--set", "environment.no_reward_limit=5", "--set", "evaluation.seconds=1")
        assert self.run(tmp_path, *limit, evaluation=470.0) == pytest.approx((470.0 - 475.0) / 475.0)

    def test_others_are_ranked_by_their_final_return(self, tmp_path: Path) -> None:
        on = "training.stop_when_solved=false"
        assert self.run(tmp_path, "--set", on, evaluation=480.0, solved=True) == 480.0


class TestSampler:
    @pytest.fixture(autouse=True)
    def _optuna(self) -> None:
        pytest.importorskip("optuna")

    def search(self, folder: Path, trials: int = 6, seeds: int = 2) -> SampledSearch:
        sampled = planner(folder, "--set", "training.stop_when_solved=false")
        return SampledSearch(sampled, [RATES, HIDDEN], range(1, 1 + seeds), trials=trials, folder=folder)

    def test_it_makes_all_seeds_of_each_point(self, tmp_path: Path) -> None:
        search = self.search(tmp_path)
        runs = make_runs(search, lambda run: 1.0)
        assert [run.name for run in runs[:4]] == [f"trial-{t:03d}_seed-{s}" for t in (1, 2) for s in (1, 2)]
        assert len(runs) == search.total == 12
        assert runs[0].point == runs[1].point
        assert all(RATES.low <= run.spec.training.learning_rate <= RATES.high for run in runs)
        assert len({run.spec.training.learning_rate for run in runs}) == 6

    def test_later_points_are_near_the_best(self, tmp_path: Path) -> None:
        """The return is highest for small learning rates: random points would have a mean of 1e-2.5."""

        def result(run: PlannedRun) -> float:
            return -run.spec.training.learning_rate

        runs = make_runs(self.search(tmp_path, trials=30, seeds=1), result)
        late = sorted(run.spec.training.learning_rate for run in runs[15:])
        assert late[len(late) // 2] < 10**-3

    def test_the_mean_of_the_seeds_is_reported(self, tmp_path: Path) -> None:
        search = self.search(tmp_path, trials=2)
        make_runs(search, lambda run: float(run.seed))
        assert [trial.value for trial in search._study.trials] == [1.5, 1.5]

    def test_a_failed_point_is_not_reported(self, tmp_path: Path) -> None:
        search = self.search(tmp_path, trials=1)
        first, second = search.take(), search.take()
        assert first is not None
        assert second is not None
        finish(second)
        search.ended(first, failed=True)
        search.ended(second, failed=False)
        assert [trial.value for trial in search._study.trials] == [None]
        assert search.take() is None

    def test_an_interrupted_sweep_goes_on_with_the_same_points(self, tmp_path: Path) -> None:
        # Stop in the middle of the second of three random points: the third must not be the first again.
        before = make_runs(self.search(tmp_path, trials=9), lambda run: 1.0, most=3)
        search = self.search(tmp_path, trials=9)
        after = []
        while (run := search.take()) is not None:
            if not (run.directory / "summary.json").exists():
                finish(run)
            search.ended(run, failed=False)
            after.append(run)
        assert len(after) == 18
        assert [run.spec for run in after[:3]] == [run.spec for run in before]
        assert len({run.spec.training.learning_rate for run in after}) == 9
        assert len([trial for trial in search._study.trials if trial.value is not None]) == 9

    def test_points_of_another_kind_of_range_are_not_reported(self, tmp_path: Path) -> None:
        """The same setting with whole numbers, after a command whose range had fractions."""
        (tmp_path / TRIALS).write_text(json.dumps({"trials": [{"training.discount_factor": "0.5"}]}))
        whole = Range(key="training.discount_factor", low=0.0, high=1.0, whole=True)
        search = SampledSearch(planner(tmp_path), [whole], [1], trials=2, folder=tmp_path)
        make_runs(search, lambda run: 1.0, most=1)
        assert search._study.trials == []

    def test_points_of_another_sweep_are_refused(self, tmp_path: Path) -> None:
        for content in ({"trials": [{"training.learning_rate": "0.1"}]}, {"trials": 3}, {}):
            (tmp_path / TRIALS).write_text(json.dumps(content))
            with pytest.raises(SettingsError, match="is damaged, or is of a sweep over other settings"):
                self.search(tmp_path)
        (tmp_path / TRIALS).write_text("{")
        with pytest.raises(SettingsError, match="is damaged: it is not valid JSON"):
            self.search(tmp_path)
