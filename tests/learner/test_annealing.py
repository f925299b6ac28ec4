"""learner/run/counters.py: no annealed setting jumps back when a run is resumed with another budget."""

import json

import pytest

from daedalus.learner.run.counters import Annealing


def test_progress_is_the_used_share_of_the_budget() -> None:
    annealing = Annealing(budget=700)
    assert [annealing.at(env_steps) for env_steps in (0, 7, 123, 700, 800)] == [0.0, 7 / 700, 123 / 700, 1.0, 1.0]


def test_resuming_with_the_same_budget_changes_nothing() -> None:
    annealing = Annealing(budget=700)
    assert annealing.resumed(300, 700) is annealing


@pytest.mark.parametrize("budget", [1400, 400])
def test_other_budget_continues_from_the_progress_that_was_reached(budget: int) -> None:
    first = Annealing(budget=700)
    resumed = first.resumed(300, budget)
    assert resumed.at(300) == first.at(300) == 300 / 700
    middle = (300 + budget) // 2
    assert resumed.at(middle) == pytest.approx((300 / 700 + 1.0) / 2)
    assert resumed.at(budget) == 1.0
    again = resumed.resumed(middle, 10_000)
    assert again.at(middle) == resumed.at(middle)
    assert again.at(10_000) == 1.0


def test_run_that_has_used_its_budget_stays_at_the_final_values() -> None:
    resumed = Annealing(budget=700).resumed(705, 1400)
    assert [resumed.at(env_steps) for env_steps in (705, 1000, 1400)] == [1.0, 1.0, 1.0]


def test_budget_that_is_used_up_already_is_the_end() -> None:
    assert Annealing(budget=700).resumed(300, 200).at(300) == 1.0


def test_restored_from_json_it_continues_equally() -> None:
    resumed = Annealing(budget=700).resumed(300, 1100)
    assert Annealing(**json.loads(json.dumps(resumed.state()))) == resumed
