"""Test of analysis/sweep_plan.py."""

import pytest

from daedalus.analysis.sweep_plan import Choices, Range, read_axis, split_values
from daedalus.learner.run.settings import SettingsError


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("1,5,20", ["1", "5", "20"]),
        ("[64,64],[32]", ["[64,64]", "[32]"]),
        ("[[0.0, 1.0], [1.0, 0.5]] , none", ["[[0.0, 1.0], [1.0, 0.5]]", "none"]),
        ('"a,b",c', ['"a,b"', "c"]),
        ("{x = 1, y = 2},{}", ["{x = 1, y = 2}", "{}"]),
        ("tanh", ["tanh"]),
    ],
)
def test_values_end_at_commas_outside_of_brackets(text: str, values: list[str]) -> None:
    assert split_values(text) == values


def test_a_list_of_values() -> None:
    axis = read_axis("collection.rollout_length = 1,5,20,64")
    assert axis == Choices(key="collection.rollout_length", values=("1", "5", "20", "64"))


@pytest.mark.parametrize(
    ("text", "low", "high", "whole", "log"),
    [
        ("training.learning_rate=1e-4..1e-2", 1e-4, 1e-2, False, True),
        ("training.discount_factor=0.9..0.999", 0.9, 0.999, False, False),
        ("collection.rollout_length=4..64", 4, 64, True, True),
        ("collection.rollout_length=4..40", 4, 40, True, False),
        ("training.entropy_bonus=0.0..0.1", 0.0, 0.1, False, False),
        ("training.entropy_bonus=-1..1", -1, 1, True, False),
    ],
)
def test_a_range_is_logarithmic_beyond_a_factor_of_10(
    text: str, low: float, high: float, whole: bool, log: bool
) -> None:
    axis = read_axis(text)
    assert axis == Range(key=text.partition("=")[0], low=low, high=high, whole=whole)
    assert isinstance(axis, Range)
    assert axis.log is log


def test_a_value_of_a_range_is_short_and_inside() -> None:
    axis = Range(key="a.b", low=0.00123456, high=0.0987654, whole=False)
    assert axis.written(0.0034567891) == "0.003457"
    assert axis.written(0.09876539) == "0.0987654"  # rounded, it would be beyond the end
    assert Range(key="a.b", low=4, high=64, whole=True).written(5) == "5"
    assert Range(key="a.b", low=1e6, high=1e6 + 1, whole=False).written(1_000_000.25) == "1000000.25"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rollout_length=1,2", "write section.key=value,value"),
        ("collection.rollout_length", "write section.key=value,value"),
        ("collection.rollout_length=", "write section.key=value,value"),
        ("colection.rollout_length=1,2", "there is no section 'colection'"),
        ("collection.rollout_length=1,,2", "a value is empty"),
        ("collection.rollout_length=5,20,5", "the value 5 is there twice"),
        ("training.learning_rate=1e-3,0.001", r"the value 0\.001 is there twice"),
        ("training.learning_rate=1e-2..1e-4", "the range is empty: write the lower end first"),
        ("training.learning_rate=1..1e999", "an end of the range is too large"),
        ("environment.kwargs.x=False,false", "the value false is there twice"),
        ("environment.kwargs.x=FALSE,true", "FALSE would be a text: write false"),
        ("environment.kwargs.x=08,9", "08 would be a text: write 8"),
        ("training.seed=1,2", "use --seeds N"),
        ("environment.id=A-v0,B-v0", "a sweep has one environment"),
    ],
)
def test_bad_input_is_one_line(text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message) as error:
        read_axis(text)
    assert "\n" not in str(error.value)


def test_underscores_are_for_numbers_between_digits_only() -> None:
    assert read_axis("training.batch_rollouts=1_0..2_0") == Range(
        key="training.batch_rollouts", low=10.0, high=20.0, whole=True
    )
    assert read_axis("training.batch_rollouts=1_..2") == Choices(key="training.batch_rollouts", values=("1_..2",))
