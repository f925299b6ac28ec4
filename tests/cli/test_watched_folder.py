"""WatchedFolder: what the page shows of a run directory, while the run goes on and at its end."""

import json
from pathlib import Path

from recorded_runs import record

from daedalus.launch.gateway_process import WatchedFolder

SECRET = "pa55w0rd"


def test_a_directory_has_settings_and_output_and_later_the_end_of_its_run(tmp_path: Path) -> None:
    settings = (f'environment.kwargs.at="http://ada:{SECRET}@host"', "policy.encoder=parts:Encoder")
    directory = record(tmp_path / "run", settings=settings)  # its summary is of an earlier life of the learner
    (directory / "output.log").write_text(f"API_TOKEN={SECRET}\n" + "[actor-0] step \u202e\n" * 3000)
    read = WatchedFolder(directory)
    assert read("another") is None
    view = read("run")
    assert view is not None
    assert ("training.target_return", "475", True) in view.settings
    assert ("training.stop_when_solved", "true", False) in view.settings
    assert SECRET not in str(view)
    assert view.output.startswith("[actor-0]")  # no line is cut
    assert "\u202e" not in view.output
    assert (view.ends, view.stopped) == ((), False)
    (directory / "summary.json").write_text(json.dumps({"finished": False, "env_steps": 1}))
    stopped = read("run")
    assert stopped is not None
    assert stopped.ends == (f"Continue it with: daedalus resume {directory} --allow-module parts",)
    assert stopped.stopped
    evaluation = {"return_mean": 490.0, "return_std": 1.5, "episodes": 100, "actions": "greedy"}
    (directory / "summary.json").write_text(json.dumps({"finished": True, "evaluation": evaluation}))
    (directory / "report.html").write_text("")
    ended = read("run")
    assert ended is not None
    assert ended.ends == (
        "Evaluation: return 490.0 ± 1.5 over 100 greedy episodes.",
        f"Report, on the host of the gateway: {directory}/report.html",
    )
    assert not ended.stopped


def test_what_cannot_be_read_is_as_it_was(tmp_path: Path) -> None:
    directory = record(tmp_path / "run")
    read = WatchedFolder(directory)
    before = read("run")
    assert before is not None
    (directory / "config.toml").write_text("[")
    (directory / "output.log").symlink_to("/etc/passwd")
    after = read("run")
    assert after is not None
    assert (after.settings, after.output) == (before.settings, "")
