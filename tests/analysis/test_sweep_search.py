"""Test of analysis/sweep_search.py."""

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
from planning import finish, planner

from daedalus.analysis.sweep_plan import Choices, PlannedRun, Range
from daedalus.analysis.sweep_search import TRIALS, GridSearch, SampledSearch, Search, import_optuna, score
from daedalus.learner.run.settings import SettingsError

RATES = Range(key="training.learning_rate", low=1e-4, high=1e-1, whole=False)
HIDDEN = Choices(key="policy.hidden", values=("[16]", "[16,16]"))


def make_runs(search: Search, result: Callable[[PlannedRun], float], most: int = 1000) -> list[PlannedRun]:
    """Take up to `most` runs, and finish those that have not ended; return them."""
    made = []
    while len(made) < most and (run := search.take()) is not None:
        if not run.directory.exists():
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

    def trials(self, folder: Path) -> list[float | None]:
        """Return the scores of the trials that Optuna keeps, None for those that are open."""
        optuna = import_optuna()
        backend = optuna.storages.journal.JournalFileBackend(str(folder / TRIALS))
        study = optuna.load_study(study_name="sweep", storage=optuna.storages.JournalStorage(backend))
        return [trial.value for trial in study.trials]

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
        assert self.trials(tmp_path) == [1.5, 1.5]

    def test_a_failed_point_is_not_reported(self, tmp_path: Path) -> None:
        search = self.search(tmp_path, trials=1)
        first, second = search.take(), search.take()
        assert first is not None
        assert second is not None
        finish(second)
        search.ended(first, failed=True)
        search.ended(second, failed=False)
        assert self.trials(tmp_path) == [None]
        assert search.take() is None

    def test_an_interrupted_sweep_goes_on_with_the_same_points(self, tmp_path: Path) -> None:
        # Stop in the middle of the second of three random points: the third must not be the first again.
        before = make_runs(self.search(tmp_path, trials=9), lambda run: 1.0, most=3)
        after = make_runs(self.search(tmp_path, trials=9), lambda run: 490.0)
        assert len(after) == 18
        assert [run.spec for run in after[:3]] == [run.spec for run in before]
        assert len({run.spec.training.learning_rate for run in after}) == 9
        assert self.trials(tmp_path) == [1.0, (1.0 + 490.0) / 2, *[490.0] * 7]

    def test_a_point_that_was_being_chosen_as_the_machine_crashed_is_chosen_again(self, tmp_path: Path) -> None:
        make_runs(self.search(tmp_path, trials=3), lambda run: 1.0, most=2)
        whole = (tmp_path / TRIALS).read_text().splitlines(keepends=True)
        chosen = next(index for index, line in enumerate(whole) if "policy.hidden" in line)
        (tmp_path / TRIALS).write_text("".join(whole[:chosen]) + whole[chosen][:9])
        runs = make_runs(self.search(tmp_path, trials=3), lambda run: 1.0)
        assert [run.name for run in runs[::2]] == ["trial-002_seed-1", "trial-003_seed-1", "trial-004_seed-1"]
        assert self.trials(tmp_path) == [None, 1.0, 1.0, 1.0]

    def test_a_failed_point_is_tried_again(self, tmp_path: Path) -> None:
        search = self.search(tmp_path, trials=1, seeds=1)
        run = search.take()
        assert run is not None
        search.ended(run, failed=True)
        assert [again.name for again in make_runs(self.search(tmp_path, trials=1, seeds=1), lambda _: 2.0)] == [
            run.name
        ]
        assert self.trials(tmp_path) == [2.0]

    def test_points_are_of_the_range_that_chose_them(self, tmp_path: Path) -> None:
        before = make_runs(self.search(tmp_path, seeds=1), lambda run: 1.0, most=3)
        narrow = Range(key=RATES.key, low=2e-4, high=2e-2, whole=False)
        search = SampledSearch(
            planner(tmp_path, "--set", "training.stop_when_solved=false"),
            [narrow, HIDDEN],
            [1],
            trials=6,
            folder=tmp_path,
        )
        again = make_runs(search, lambda run: 1.0)
        assert [run.spec for run in again[:3]] == [run.spec for run in before]
        assert all(2e-4 <= run.spec.training.learning_rate <= 2e-2 for run in again[3:])

    def test_trials_of_another_sweep_are_refused(self, tmp_path: Path) -> None:
        make_runs(self.search(tmp_path), lambda run: 1.0, most=1)
        for axes in (
            [RATES],
            [RATES, Choices(key=HIDDEN.key, values=("[8]", "[16]"))],
            [Range(key=RATES.key, low=1, high=1000, whole=True), HIDDEN],
        ):
            with pytest.raises(SettingsError, match="is of a sweep over other settings or other kinds of values"):
                SampledSearch(planner(tmp_path), axes, [1], trials=2, folder=tmp_path)

    @pytest.mark.parametrize("content", ["x\n", "{}\n", "[1]\n", '{"op_code": 4, "worker_id": "a"}\n'])
    def test_damaged_trials_are_refused(self, tmp_path: Path, content: str) -> None:
        (tmp_path / TRIALS).write_text(content * 2)
        with pytest.raises(SettingsError, match=r"trials\.jsonl is damaged \(\w+\): choose another --folder"):
            self.search(tmp_path)

    def test_trials_of_an_older_release_are_refused(self, tmp_path: Path) -> None:
        (tmp_path / "trials.json").write_text("{}")
        with pytest.raises(SettingsError, match="is of a sweep of an older release"):
            self.search(tmp_path)

    def test_nothing_that_executes_reads_or_writes_the_trials(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse(*_: object) -> None:
            raise AssertionError

        monkeypatch.setattr(pickle, "loads", refuse)
        monkeypatch.setattr(pickle, "dumps", refuse)
        make_runs(self.search(tmp_path, seeds=1), lambda run: 1.0, most=3)
        assert len(make_runs(self.search(tmp_path, seeds=1), lambda run: 1.0)) == 6
