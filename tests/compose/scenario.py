"""Test of docker-compose.yml with real containers that are started, stopped and killed: `make test-compose`."""

import json
from pathlib import Path
from typing import Any

import yaml
from composition import HERE, Compose
from docker_host import run

from daedalus.cli.commands.learner import parser
from daedalus.cli.settings_arguments import new_run

Status = dict[str, Any]


def trained_actors(status: Status | None) -> dict[str, int]:
    """Return the env_steps of the live actors that were trained on, by name."""
    actors = status["actors"] if status else []
    return {actor["actor"]: actor["env_steps"] for actor in actors if actor["alive"] and actor["env_steps"]}


def have_continued(before: dict[str, int], status: Status | None) -> bool:
    """Return whether exactly these actors take part and more of each was trained on."""
    now = trained_actors(status)
    return now.keys() == before.keys() and all(now[name] > before[name] for name in before)


def test_the_command_of_the_endless_learner_is_valid() -> None:
    command = yaml.safe_load((HERE / "endless.yml").read_text())["services"]["learner"]["command"]
    new = new_run(parser().parse_args(command[1:]))
    assert new.directory is not None
    assert (new.choice.spec().training.stop_when_solved, new.directory.name) == (False, "endless")


def test_training_survives_killed_containers_and_solves_cartpole(compose: Compose, tmp_path: Path) -> None:
    compose.up(2)
    compose.wait("two actors play", lambda: len(trained_actors(compose.status())) == 2)

    compose.up(5)
    compose.wait("five actors play", lambda: len(trained_actors(compose.status())) == 5)
    five = trained_actors(compose.status())

    victim = compose.containers("actor")[0]
    run("docker", "kill", victim)
    compose.wait("the killed actor is gone", lambda: len(trained_actors(compose.status())) == 4)
    four = trained_actors(compose.status())
    assert four.keys() < five.keys()
    compose.wait("the other four continue", lambda: have_continued(four, compose.status()))
    compose.up(5)
    compose.wait("the fifth is back under its name", lambda: have_continued(five, compose.status()))

    compose.wait("a checkpoint is saved", lambda: (compose.status() or {}).get("checkpoint_age_seconds") is not None)
    (learner,) = compose.containers("learner")
    compose("kill", "learner")
    compose.wait("the learner is gone", lambda: not compose.state(learner)["Running"] and compose.status() is None)
    compose.up(5)
    compose.wait("the learner is back", lambda: compose.status())
    assert "resuming from checkpoint" in compose("logs", "learner")
    back = dict.fromkeys(five, 0)
    compose.wait("all five actors play again", lambda: have_continued(back, compose.status()))
    # The new learner process counts the actors from 1.
    assert {actor["lives"] for actor in (compose.status() or {})["actors"]} == {1}

    compose.wait(
        "the health check of the learner passes", lambda: compose.state(learner)["Health"]["Status"] == "healthy"
    )
    assert compose.containers("learner") == [learner]

    # The shipped configuration: the run and the containers end when CartPole is solved.
    compose("stop", "learner", "actor")
    compose.endless = False
    compose.up(2)
    (learner,) = compose.containers("learner")
    compose.wait("the run ends", lambda: compose.state(learner)["Status"] == "exited")
    output = compose("logs", "--tail", "5", "learner")
    assert compose.state(learner)["ExitCode"] == 0, output
    run("docker", "cp", f"{learner}:/runs/cartpole/summary.json", tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["solved"]
