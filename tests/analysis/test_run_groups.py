"""Test of analysis/run_groups.py."""

import json
from pathlib import Path

from recorded_runs import record

from daedalus.analysis.comparison import as_text, compare_groups
from daedalus.analysis.recorded_run import RecordedRun, read_run
from daedalus.analysis.run_groups import by_settings, by_user, environment_of, select
from daedalus.learner.run.settings import value_text


def run(folder: Path, name: str, *settings: str, seed: int = 1, preset: str = "cartpole") -> RecordedRun:
    return read_run(record(folder / name, seed=seed, settings=settings, preset=preset))


def names(*runs: RecordedRun) -> list[tuple[str, list[str]]]:
    return [(group.name, [run.directory.name for run in group.runs]) for group in by_settings(runs)]


def test_seeds_of_one_setting_are_one_group(tmp_path: Path) -> None:
    runs = [run(tmp_path, f"s{seed}", seed=seed) for seed in (1, 2)]
    assert names(*runs) == [("CartPole-v1, impala", ["s1", "s2"])]


def test_runs_from_weights_or_demonstrations_are_no_seeds_of_those_from_nothing(tmp_path: Path) -> None:
    """Runs that began with the weights of different runs are: each seed may go on from its own."""
    for seed in range(1, 5):
        record(tmp_path / f"s{seed}", seed=seed)
    for seed in (2, 3):
        (tmp_path / f"s{seed}" / "versions.json").write_text(json.dumps({"init_from": f"/runs/first-{seed}"}))
    (tmp_path / "s4" / "demonstrations").mkdir()
    assert sorted(names(*(read_run(tmp_path / f"s{seed}") for seed in range(1, 5)))) == [
        ("begun_with=demonstrations", ["s4"]),
        ("begun_with=unset", ["s1"]),
        ("begun_with=weights", ["s2", "s3"]),
    ]


def test_settings_of_the_service_make_no_groups_unless_they_are_named(tmp_path: Path) -> None:
    runs = [run(tmp_path, f"k{number}", f"service.keep_checkpoints={number}") for number in (3, 50)]
    assert names(*runs) == [("CartPole-v1, impala", ["k3", "k50"])]
    named = by_settings(runs, ["service.keep_checkpoints"])
    assert [group.name for group in named] == ["keep_checkpoints=3", "keep_checkpoints=50"]


def test_groups_have_the_name_of_what_differs_and_its_order(tmp_path: Path) -> None:
    runs = [run(tmp_path, f"n{n}", f"collection.rollout_length={n}") for n in (64, 5, 20)]
    assert names(*runs) == [
        ("rollout_length=5", ["n5"]),
        ("rollout_length=20", ["n20"]),
        ("rollout_length=64", ["n64"]),
    ]


def test_all_settings_that_differ_name_the_groups(tmp_path: Path) -> None:
    """The algorithm first: other settings of a preset depend on it."""
    other = ("training.algorithm=a3c", "training.learning_rate=0.001", "environment.kwargs.x=None")
    runs = [run(tmp_path, "a"), run(tmp_path, "b", *other)]
    assert names(*runs) == [
        ("algorithm=a3c, x=none, learning_rate=0.001", ["b"]),
        ("algorithm=impala, x=unset, learning_rate=0.003", ["a"]),
    ]
    assert [group.unnamed for group in by_settings(runs)] == [[], []]
    assert by_settings(runs, ["training.algorithm"])[0].unnamed == ["environment.kwargs.x", "training.learning_rate"]


def test_a_name_of_many_settings_is_short_and_says_how_many_more_differ(tmp_path: Path) -> None:
    other = [f"training.{name}=0.5" for name in ("discount_factor", "entropy_bonus", "trace_lambda", "rho_clip")]
    runs = [run(tmp_path, "a"), run(tmp_path, "b", "environment.kwargs.map=" + "m" * 30, *other)]
    named = by_settings(runs)[0]
    assert named.name.startswith(f"map={'m' * 21}..., discount_factor=0.5")
    assert (named.name.endswith(", +1 more"), named.unnamed) == (True, ["training.trace_lambda"])
    assert "the groups also differ in training.trace_lambda" in as_text([compare_groups(by_settings(runs))])
    longer = [run(tmp_path, f"n{n}", "environment.kwargs.map=" + "m" * n) for n in (30, 31)]
    assert [name for name, _ in names(*longer)] == ["map=" + "m" * n for n in (30, 31)]  # shortened, they were equal


def test_two_settings_name_the_groups_of_a_grid(tmp_path: Path) -> None:
    grid = [(n, rate) for n in (5, 20) for rate in (0.1, 0.01)]
    runs = [
        run(tmp_path, f"{n}-{rate}", f"collection.rollout_length={n}", f"training.learning_rate={rate}")
        for n, rate in grid
    ]
    assert [name for name, _ in names(*runs)] == [
        "rollout_length=5, learning_rate=0.01",
        "rollout_length=5, learning_rate=0.1",
        "rollout_length=20, learning_rate=0.01",
        "rollout_length=20, learning_rate=0.1",
    ]


def test_named_settings_name_the_groups(tmp_path: Path) -> None:
    runs = [run(tmp_path, f"n{n}", f"collection.rollout_length={n}") for n in (5, 20)]
    groups = by_settings(runs, ["training.learning_rate", "collection.rollout_length"])
    assert [group.name for group in groups] == [
        "learning_rate=0.003, rollout_length=5",
        "learning_rate=0.003, rollout_length=20",
    ]


def test_part_of_a_setting_that_is_a_table_names_the_groups(tmp_path: Path) -> None:
    runs = [run(tmp_path, f"g{value}", f"environment.kwargs.gravity={value}") for value in (9.5, 1.5, "low")]
    named = by_settings([*runs, run(tmp_path, "plain")], ["environment.kwargs.gravity"])
    assert [group.name for group in named] == ["gravity=1.5", "gravity=9.5", "gravity=low", "gravity=unset"]
    assert runs[0].setting("environment.kwargs.gravity.deeper") is None
    assert runs[0].setting("environment") is None


def test_groups_of_the_user_keep_their_order(tmp_path: Path) -> None:
    parts = [[run(tmp_path, "b", "policy.hidden=[64]")], [run(tmp_path, "a", "policy.hidden=[32,32]")]]
    assert [group.name for group in by_user(parts)] == ["hidden=[64]", "hidden=[32,32]"]


def test_groups_of_the_user_are_named_by_all_values_of_their_runs(tmp_path: Path) -> None:
    mixed = [run(tmp_path, "a"), run(tmp_path, "b", "policy.hidden=[32]")]
    assert [group.name for group in by_user([mixed, [run(tmp_path, "c")]])] == ["hidden=[32]/[64,64]", "hidden=[64,64]"]


def test_groups_of_the_user_that_no_setting_tells_apart_have_the_names_of_runs(tmp_path: Path) -> None:
    both = [[run(tmp_path, "a"), run(tmp_path, "b", seed=2)], [run(tmp_path, "c", seed=3)]]
    assert [group.name for group in by_user(both)] == ["CartPole-v1, impala", "c"]


def test_each_environment_has_groups_of_its_own(tmp_path: Path) -> None:
    for name, settings in (("a", []), ("b", ["collection.rollout_length=5"]), ("c", [])):
        record(tmp_path / name, settings=settings, preset="acrobot" if name == "c" else "cartpole")
    record(tmp_path / "d", finished=False, evaluation=None)
    (record(tmp_path / "e") / "config.toml").write_text("")
    environments, left_out = select([[tmp_path]], finished=True)
    names = [(environment_of(groups), [group.name for group in groups]) for groups in environments]
    assert names == [
        ("Acrobot-v1", ["c"]),
        ("CartPole-v1", ["rollout_length=5", "rollout_length=32"]),
        ("", ["e"]),
    ]
    (unfinished,) = left_out
    assert unfinished.startswith(f"left out: {tmp_path / 'd'} is not finished")
    (groups,), _ = select([[tmp_path / "a", tmp_path / "e"]], finished=True)  # which can only be of CartPole-v1
    assert len(groups) == 2


def test_groups_of_the_user_are_compared_within_each_environment(tmp_path: Path) -> None:
    for name in ("old-cartpole", "old-acrobot", "new-cartpole"):
        record(tmp_path / name, preset=name.partition("-")[2])
    environments, left_out = select([sorted(tmp_path.glob("old-*")), sorted(tmp_path.glob("new-*"))], finished=True)
    assert [[len(group.runs) for group in groups] for groups in environments] == [[1], [1, 1]]
    assert left_out == ["left out: group 2 has no run of Acrobot-v1"]


def test_values_are_short_texts() -> None:
    values = [1, True, 0.0003, 1e-10, [64, 64], None, "tanh"]
    assert [value_text(value) for value in values] == ["1", "true", "0.0003", "1e-10", "[64,64]", "unset", "tanh"]
