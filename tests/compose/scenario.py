"""docker-compose.yml for real: containers that come, go and are killed while a learner learns. `make test-compose`."""

import json
from pathlib import Path
from typing import Any

import yaml
from composition import HERE, Compose
from docker_host import run

from daedalus.cli.settings_arguments import learner_parser, resolve

Status = dict[str, Any]


def playing(status: Status | None) -> dict[str, int]:
    """The env_steps of the actors that take part and were learned from, by name."""
    actors = status["actors"] if status else []
    return {actor["actor"]: actor["env_steps"] for actor in actors if actor["alive"] and actor["env_steps"]}


def have_gone_on(before: dict[str, int], status: Status | None) -> bool:
    """Whether exactly those actors play, and more was learned from each."""
    now = playing(status)
    return now.keys() == before.keys() and all(now[name] > before[name] for name in before)


def test_the_endless_learner_is_one_that_we_take() -> None:
    command = yaml.safe_load((HERE / "endless.yml").read_text())["services"]["learner"]["command"]
    spec, directory = resolve(learner_parser().parse_args(command[1:]))
    assert (spec.training.stop_when_solved, directory.name) == (False, "endless")


def test_containers_come_go_and_are_killed_and_cartpole_is_solved(compose: Compose, tmp_path: Path) -> None:
    compose.up(2)
    compose.wait("two actors play", lambda: len(playing(compose.status())) == 2)

    compose.up(5)
    compose.wait("five actors play", lambda: len(playing(compose.status())) == 5)
    five = playing(compose.status())

    victim = compose.containers("actor")[0]
    run("docker", "kill", victim)
    compose.wait("one is gone", lambda: len(playing(compose.status())) == 4)
    four = playing(compose.status())
    assert four.keys() < five.keys()
    compose.wait("the other four go on", lambda: have_gone_on(four, compose.status()))
    compose.up(5)
    compose.wait("the fifth is back, under its name", lambda: have_gone_on(five, compose.status()))

    compose.wait("a checkpoint is saved", lambda: (compose.status() or {}).get("checkpoint_age_seconds") is not None)
    (learner,) = compose.containers("learner")
    compose("kill", "learner")
    compose.wait("the learner is gone", lambda: not compose.state(learner)["Running"] and compose.status() is None)
    compose.up(5)
    compose.wait("it is back", lambda: compose.status())
    assert "resuming from checkpoint" in compose("logs", "learner")
    back = dict.fromkeys(five, 0)
    compose.wait("all five play for it again", lambda: have_gone_on(back, compose.status()))
    assert {actor["lives"] for actor in (compose.status() or {})["actors"]} == {1}  # of those that this learner knew

    compose.wait("its health check passes", lambda: compose.state(learner)["Health"]["Status"] == "healthy")
    assert compose.containers("learner") == [learner]

    # As it is shipped: the run ends when it is solved, and so do the containers.
    compose("stop", "learner", "actor")
    compose.endless = False
    compose.up(2)
    (learner,) = compose.containers("learner")
    compose.wait("the run ends", lambda: compose.state(learner)["Status"] == "exited")
    said = compose("logs", "--tail", "5", "learner")
    assert compose.state(learner)["ExitCode"] == 0, said
    run("docker", "cp", f"{learner}:/runs/cartpole/summary.json", tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["solved"]
