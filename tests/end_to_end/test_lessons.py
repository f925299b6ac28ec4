"""Lessons over several hosts: the example's task, which is learned only with them (docs/guides/lessons.md)."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from hosts import Network, network_in
from processes import Running, command_line, here, starting

from daedalus.learner.reporting.metrics_rows import read_rows

EXAMPLE = Path(__file__).parents[2] / "examples" / "lessons.py"
PORT, ALLOWED = 7447, ("--allow-module", "lessons")
TASK = ("--env", "lessons:Path", "--set", "environment.parameters.stones=30")
LESSONS = ("--set", "lessons.stones.steps=[1, 2, 4, 8, 16]", "--set", "lessons.stones.above=0.8")


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    (tmp_path / "lessons.py").write_text(EXAMPLE.read_text())
    with network_in(tmp_path) as made:
        yield made


def test_actors_on_two_hosts_learn_a_task_by_lessons_and_a_host_that_refuses_them_is_named(
    network: Network, tmp_path: Path
) -> None:
    central, refusing, *hosts = (network.host(name) for name in ("central", "refusing", "arm", "box"))
    address = f"tcp/{central.address}:{PORT}"
    narrow = tmp_path / "narrow"  # the environment as another host has it
    narrow.mkdir()
    checked = "STONES)\n        assert stones <= 9, 'at most 9 stones fit here'\n"
    (narrow / "lessons.py").write_text(EXAMPLE.read_text().replace("STONES)\n", checked, 1))
    budget = ("--actors", 2, "--env-steps", 30_000, "--insecure", "--listen", address, "--run-dir", "run")
    learner = central.start("learner", *TASK, *LESSONS, *budget)
    learner.expect("actors join with")

    words = ("actor", "--connect", address, "--name", "refusing", *ALLOWED)
    refused = refusing.run("env", "-C", narrow, *command_line(*words))
    assert refused.wait() == 1
    reason = "reset with the options stones=30 raises AssertionError: at most 9 stones fit here"
    assert reason in refused.lines[-1]

    actors = [host.start("actor", "--connect", address, "--name", host.name, *ALLOWED) for host in hosts]
    learner.expect("lesson stones: 2 ")
    status = central.start("status", "--connect", address)
    status.expect("lesson stones: ")
    status.expect("refused: refusing .*, 1 x, ")
    assert learner.wait() == 0, learner.output
    for actor in actors:
        assert actor.wait() == 0, actor.output

    rows = read_rows(tmp_path / "run" / "metrics.csv")
    played = [row["lesson/stones"] for row in rows if "lesson/stones" in row]
    assert played[-1] == 30.0, played
    assert min(played) < 3.0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["lessons"] == {"stones": "30 (the true task)"}
    evaluation = central.start("evaluate", "run", "--episodes", 20, *ALLOWED, "--json")
    assert evaluation.wait() == 0, evaluation.output
    assert json.loads(evaluation.output[evaluation.output.index("{") :])["return_mean"] > 0.9


def test_a_parameter_that_the_environment_does_not_have_is_named_before_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lessons.py").write_text(EXAMPLE.read_text())
    wrong = ("--set", "environment.parameters.stone=30", "--set", "lessons.stone.between=[1,30]")
    with starting(tmp_path) as start:
        refused: list[Running] = [start("train", *TASK, *wrong), start("check", *TASK, *wrong)]
        for process in refused:
            assert process.wait() in (1, 2), process.output
            assert "has no parameter stone: reset reads stones of its options" in process.output
    monkeypatch.chdir(tmp_path)
    unset = here("train", *TASK, "--set", "lessons.stone.between=[1,30]")
    assert unset.status == 2
    unset.expect("set environment.parameters.stone, which evaluations play")
    assert not (tmp_path / "runs").exists()
