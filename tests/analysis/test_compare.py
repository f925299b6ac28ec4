"""Test of `daedalus compare`."""

import csv
import json
import re
from pathlib import Path

import pytest
from league_statuses import LEAGUE
from recorded_runs import record

from daedalus.cli.commands.compare import compare

FAST, SLOW = ("collection.rollout_length=5",), ("collection.rollout_length=64",)


def five(folder: Path, name: str, settings: tuple[str, ...], evaluation: float, env_steps: int) -> None:
    """Record five seeds that reach the target after `env_steps` or up to 4 env_steps later."""
    for seed in range(5):
        record(
            folder / f"{name}-s{seed}",
            seed=seed,
            settings=settings,
            evaluation=evaluation + seed,
            env_steps=(1000, 2000, env_steps + seed),
            solved=True,
            seconds_to_target=60.0 + seed,
        )


def test_groups_are_found_and_compared(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    five(folder / "runs", "slow", SLOW, 400.0, 9000)
    five(folder / "runs", "fast", FAST, 480.0, 3000)
    assert compare(["runs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    header, _, fast, slow = (" ".join(line.split()) for line in lines[:4])
    assert header == "group runs final return reached env_steps to 475 minutes to 475 P(> first)"
    interval = r"\[(\S+), (\S+)\]"
    assert re.fullmatch(rf"rollout_length=5 5 482\.0 {interval} 5 of 5 3,002 {interval} 1\.03 {interval}", fast)
    match = re.match(rf"rollout_length=64 5 402\.0 {interval} 5 of 5 9,002 {interval} 1\.03 {interval}", slow)
    assert match is not None
    assert 400.0 <= float(match[1]) < 402.0 < float(match[2]) <= 404.0
    assert slow.endswith(" 0.00 [0.00, 0.00]")
    assert "final return: mean of the final evaluation" in lines[-2]


def test_groups_can_be_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    five(folder, "slow", SLOW, 400.0, 9000)
    five(folder, "fast", FAST, 480.0, 3000)
    slow, fast = ([str(path) for path in sorted(folder.glob(f"{name}-*"))] for name in ("slow", "fast"))
    assert compare([*slow, "--threshold", "300", "--", *fast, "--csv", "table.csv"]) == 0
    assert "env_steps to 300" in capsys.readouterr().out
    with open("table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["group"] for row in rows] == ["rollout_length=64", "rollout_length=5"]
    assert [float(row["improvement"] or "nan") for row in rows[1:]] == [1.0]
    assert rows[0]["improvement"] == ""
    assert [(float(row["env_steps"]), float(row["minutes"])) for row in rows] == [(2000.0, 2.0)] * 2


def test_runs_without_an_evaluation_are_compared_by_their_training(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(folder / "a", seed=1, evaluation=None)
    record(folder / "b", seed=2, evaluation=9.0, returns=(1.0, 2.0, 470.0))
    assert compare(["a", "b"]) == 0
    output = capsys.readouterr().out
    assert "475.0 [470.0, 480.0]" in output
    assert "final return: mean of the last training episodes" in output
    assert "never" in output  # a half of the runs did not reach the target


def test_evaluations_with_other_actions_are_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed, (name, actions) in enumerate({"a": "greedy", "b": "sampled"}.items()):
        path = record(folder / name, seed=seed) / "summary.json"
        path.write_text(
            json.dumps(json.loads(path.read_text()) | {"evaluation": {"actions": actions, "backend": "ale"}})
        )
    assert compare(["a", "b"]) == 0
    assert "played in different ways: greedy on ale, sampled on ale" in capsys.readouterr().out
    assert compare(["a"]) == 0
    assert "different ways" not in capsys.readouterr().out


def test_a_run_that_was_stopped_and_evaluated_is_counted(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "a", seed=1)
    record(folder / "b", seed=2, finished=False, evaluation=3.0)
    assert compare(["a", "b"]) == 0
    assert "1 of the runs were stopped before their end" in capsys.readouterr().out
    assert compare(["a"]) == 0
    assert "stopped" not in capsys.readouterr().out


def test_a_threshold_is_reached_by_evaluations_where_training_plays_another_task(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The shaped return of training reaches 475 at once, the true one of the evaluation after 2,000 env_steps."""
    shaped = ["environment.training_kwargs.bonus=10"]
    record(folder / "shaped", settings=shaped, returns=(900.0, 900.0, 900.0), evaluations={1: 470.0, 2: 480.0})
    record(folder / "plain", evaluations={0: 475.0})
    assert compare(["shaped", "plain"]) == 0
    output = capsys.readouterr().out
    rows = [" ".join(line.split()) for line in output.splitlines()]
    assert [row.split()[1:6] for row in rows[2:4]] == [
        ["1", "490.0", "1", "of", "1"],
        ["1", "490.0", "1", "of", "1"],
    ]
    assert {row.split()[0]: row.split()[6] for row in rows[2:4]} == {"bonus=10": "2,950", "bonus=unset": "950"}
    assert "by evaluations during training" in output


def test_returns_of_different_tasks_are_not_compared(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "shaped", settings=["environment.no_reward_limit=9"], evaluation=None)
    record(folder / "plain", evaluation=None)
    assert compare(["shaped", "plain"]) == 0
    output = capsys.readouterr().out
    assert [line.split()[1:] for line in output.splitlines()[2:4]] == [["1", "-", "-", "-", "-"], ["1", *"-----"]]
    assert "final returns cannot be compared: training plays different tasks" in output
    assert "such as with: daedalus evaluate " in output
    record(folder / "same", settings=["environment.no_reward_limit=9"], seed=2, evaluation=None)
    assert compare(["shaped", "same"]) == 0
    assert "cannot be compared" not in capsys.readouterr().out


def test_a_run_in_which_no_episode_has_ended_is_not_taken_for_the_best(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(4):
        record(folder / f"fast-{seed}", settings=FAST, seed=seed, evaluation=None)
        returns = (None, None, None) if seed == 3 else (1.0, 2.0, 3.0)
        record(folder / f"slow-{seed}", settings=SLOW, seed=seed, evaluation=None, returns=returns)
    assert compare([str(path) for path in folder.iterdir()]) == 0
    output = capsys.readouterr().out
    fast, slow = (line.split() for line in output.splitlines()[2:4])
    assert (fast[2], slow[2], slow[-1]) == ("480.0", "-", "-")
    assert "no episode has ended" in output


def test_one_seed_has_no_interval(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "a", settings=FAST)
    record(folder / "b", settings=SLOW)
    assert compare(["a", "b"]) == 0
    output = capsys.readouterr().out
    assert "[" not in output.splitlines()[2]
    assert "one run only, so without an interval: rollout_length=5 and rollout_length=64; train more seeds" in output


def test_runs_with_other_targets_have_no_threshold(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "a")
    record(folder / "b", settings=["training.target_return=none"])
    assert compare(["a", "b"]) == 0
    output = capsys.readouterr().out
    assert "env_steps and minutes to a return: name the return with `daedalus compare --threshold`" in output
    assert "minutes to 475" not in output


def test_a_folder_of_several_environments_has_a_table_for_each(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    five(folder / "runs", "slow", SLOW, 400.0, 9000)
    five(folder / "runs", "fast", FAST, 480.0, 3000)
    record(folder / "runs/acrobot", preset="acrobot", returns=(-500.0, -90.0, -80.0), evaluation=-75.0)
    assert compare(["runs", "--csv", "table.csv"]) == 0
    acrobot, cartpole = capsys.readouterr().out.split("\n\n\n")
    assert acrobot.startswith("Acrobot-v1: 1 run\n\ngroup ")
    assert re.search(r"\nacrobot +1 +-75\.0 +1 of 1", acrobot)
    assert cartpole.startswith("CartPole-v1: 10 runs\n\ngroup ")
    assert "\nrollout_length=5 " in cartpole
    with open("table.csv", newline="") as file:
        rows = [(row["environment"], row["group"]) for row in csv.DictReader(file)]
    names = ["rollout_length=5", "rollout_length=64"]
    assert rows == [("Acrobot-v1", "acrobot"), *(("CartPole-v1", name) for name in names)]


def test_runs_that_cannot_be_used_are_left_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "good")
    record(folder / "running", finished=False, evaluation=None)
    (record(folder / "damaged") / "metrics.csv").write_text("env_steps,episode_return_mean,wall_seconds\n1,2\n")
    assert compare(["good", "running", "damaged"]) == 0
    running, damaged = capsys.readouterr().err.splitlines()
    assert running == (
        "daedalus compare: left out: running is not finished (3,000 of 1,500,000 env_steps): "
        "continue it with: daedalus resume running"
    )
    assert damaged == (
        "daedalus compare: left out: damaged/metrics.csv is damaged: line 2 has 2 cells, and the header has 3"
    )


def test_control_characters_of_a_run_do_not_reach_the_terminal(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, colour in enumerate(("[31mred", "[32mgreen")):
        config = record(folder / f"run-{number}", evaluation=1.0) / "config.toml"
        config.write_text(config.read_text().replace('"tanh"', f'"\\u001b{colour}"'))
    assert compare(["run-0", "run-1"]) == 0
    output = capsys.readouterr()
    assert "\x1b" not in output.out + output.err
    assert "activation=\\x1b[31mred" in output.out


def test_nothing_to_compare_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "a")
    record(folder / "running", finished=False, evaluation=None)
    (folder / "empty").mkdir()
    for words, message in (
        (["nowhere"], "nowhere does not exist"),
        (["empty"], "empty is not a run directory"),
        (["running"], "running is not finished"),
        (["a", "--", "running"], "running is not finished"),
        (["a", "--csv", "no/table.csv"], "no/table.csv: No such file or directory"),
    ):
        assert compare(words) == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert captured.err.startswith(f"daedalus compare: {message}")


def test_runs_of_games_with_opponents_are_better_compared_by_playing(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(folder / "a", league=LEAGUE)
    assert compare(["a"]) == 0
    assert "daedalus evaluate RUN --against RUN2" in capsys.readouterr().out
    record(folder / "b")
    assert compare(["b"]) == 0
    assert "--against" not in capsys.readouterr().out
