"""cli/commands/train.py: the last lines of `daedalus train`."""

from pathlib import Path

from league_statuses import LEAGUE

from daedalus.cli.commands.train import report
from daedalus.launch.local_run import LocalRun
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

SUMMARY = {
    "solved": False,
    "env_steps": 1234,
    "updates": 5,
    "evaluation": {
        "return_mean": 1.0,
        "return_std": 0.0,
        "episodes": 3,
        "actions": "greedy",
        "best_checkpoint": False,
        "backend": "gymnasium",
        "environment": "CartPole-v1",
        "notes": ["7 of 9 episodes were cut"],
    },
}


def test_notes_of_the_evaluation_are_printed() -> None:
    run = LocalRun(directory=Path("runs/one"), spec=RunSpec(environment=EnvironmentSpec(id="CartPole-v1")), started=0.0)
    end = "episodes of the newest checkpoint on CartPole-v1 (backend gymnasium)\n7 of 9 episodes were cut"
    assert report(run, SUMMARY).endswith(end)


def test_the_rating_of_a_game_with_opponents_is_printed() -> None:
    run = LocalRun(directory=Path("runs/one"), spec=RunSpec(environment=EnvironmentSpec(id="CartPole-v1")), started=0.0)
    line = "league: rating 1,312 +- 50 of the newest policy; wins 75% against my_bots:Greedy, 97% against random"
    assert report(run, {**SUMMARY, "league": LEAGUE.model_dump(mode="json")}).splitlines()[1] == line
    assert "league" not in report(run, SUMMARY)


def test_skipped_updates_are_counted() -> None:
    run = LocalRun(directory=Path("runs/one"), spec=RunSpec(environment=EnvironmentSpec(id="CartPole-v1")), started=0.0)
    assert "5 updates (2 skipped)" in report(run, {**SUMMARY, "updates_skipped": 2})
    assert "skipped" not in report(run, {**SUMMARY, "updates_skipped": 0})


def test_duration_to_the_target_is_apart_from_the_counts_of_the_whole_run() -> None:
    """A run that trains on after its target has more env_steps at its end."""
    environment = EnvironmentSpec(id="CartPole-v1")
    spec = RunSpec.model_validate({"environment": environment, "training": {"target_return": 475.0}})
    run = LocalRun(directory=Path("runs/one"), spec=spec, started=0.0)
    text = report(run, {**SUMMARY, "solved": True, "seconds_to_target": 15.12})
    assert text.startswith("solved: mean return 475 reached after 15.1 s; 1,234 env_steps, 5 updates in all\n")
