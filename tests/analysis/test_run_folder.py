"""`daedalus runs` on a folder of runs: tags, notes, the best, and what prune keeps."""

import json
from pathlib import Path

import pytest
from league_statuses import LEAGUE
from recorded_runs import record

from daedalus.analysis.run_folder import remove_run
from daedalus.cli.commands.compare import compare
from daedalus.cli.commands.runs import runs
from daedalus.learner.run.run_lock import RunInUseError, RunLock


def said(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> str:
    """Run `daedalus runs` and return what it printed to standard output, or its error."""
    assert runs([*words]) == status
    out, err = capsys.readouterr()
    if status:
        assert err.count("\n") == 1, err
    return err if status else out


def listed(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, dict[str, object]]:
    lines = said(capsys, "list", *words, "--json").splitlines()
    return {value["directory"]: value for value in map(json.loads, lines)}


def test_tags_and_notes_are_kept_in_the_run_and_select_runs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, rows in (("a", 5), ("b", 5), ("c", 64)):
        record(folder / "runs" / name, settings=[f"collection.rollout_length={rows}"])
    said(capsys, "tag", "old", "runs/a", "runs/b")
    said(capsys, "tag", "new", "runs/c", "runs/b")
    said(capsys, "note", "runs/b", "the third  seed\ndiverged")
    assert list(listed(capsys, "runs@old")) == ["runs/a", "runs/b"]
    assert list(listed(capsys, "@new")) == ["runs/b", "runs/c"]
    said(capsys, "tag", "new", "runs/b", "--remove")
    b = listed(capsys)["runs/b"]
    assert (b["tags"], b["note"], b["status"], b["return"]) == (["old"], "the third seed diverged", "finished", 490.0)
    assert "note: the third seed diverged" in said(capsys, "show", "runs/b")
    assert compare(["runs@old", "--", "runs@new"]) == 0
    rows = [line.split()[:2] for line in capsys.readouterr().out.splitlines()[2:4]]
    assert rows == [["rollout_length=5", "2"], ["rollout_length=64", "1"]]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["tag", "a/../b", "runs"], "the tag 'a/../b' must be 1 to 64 letters, digits"),
        (["tag", "x\x1b[31m", "runs"], "must be 1 to 64 letters, digits"),
        (["tag", "@", "runs"], "must be 1 to 64"),
        (["list", "runs@none"], "no run in runs has the tag 'none': the tags there are paper"),
        (["list", "runs@two words"], "the tag 'two words' must be"),
        (["list", "elsewhere@paper"], "elsewhere does not exist: name a run directory, or a folder"),
        (["list", "runs/a@paper"], "runs/a is a run directory: a tag is that of runs in a folder, such as runs@paper"),
        (["list", "x" * 5000 + "@paper"], "File name too long"),
        (["note", "runs/a", "token=abcdefgh"], "the note has a password, a token"),
        (["note", "runs", "text"], "runs is a folder of run directories: name one of them"),
        (["note", "runs/a", "x" * 3000], "the note has more than 2,000 bytes"),
    ],
)
def test_a_mistake_is_one_line_and_changes_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    record(folder / "runs" / "a")
    said(capsys, "tag", "paper", "runs/a")
    labels = (folder / "runs" / "a" / "labels.json").read_text()
    assert message in said(capsys, *words, status=1)
    assert (folder / "runs" / "a" / "labels.json").read_text() == labels


def test_damaged_labels_are_named_and_keep_their_run(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "runs" / "a", evaluation=1.0)
    record(folder / "runs" / "b")
    for damaged in ('{"tags": ["../x"]}', '{"tags": 3}', "[", '{"note": 7}'):
        (folder / "runs" / "a" / "labels.json").write_text(damaged)
        assert "is damaged" in str(listed(capsys)["runs/a"]["problem"])
        assert "keeps   runs/a:" in said(capsys, "prune")


@pytest.mark.parametrize("steps", ["nan", "inf", "1e300", ""])
def test_a_number_of_steps_that_is_none_is_damage(folder: Path, capsys: pytest.CaptureFixture[str], steps: str) -> None:
    metrics = record(folder / "runs" / "a") / "metrics.csv"
    metrics.write_text(metrics.read_text().replace(",3000,", f",{steps},"))
    assert "env_steps has a value that is no number of steps" in str(listed(capsys)["runs/a"]["problem"])


def test_the_best_is_found_by_evaluations_of_one_task(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "runs" / "trained", evaluation=None, returns=(1.0, 2.0, 499.0))
    record(folder / "runs" / "good", evaluation=480.0)
    record(folder / "runs" / "later", evaluation=480.0, env_steps=(1000, 2000, 4000))
    record(folder / "runs" / "bad", evaluation=30.0)
    record(folder / "runs" / "other", evaluation=900.0, settings=["environment.max_episode_steps=1000"])
    record(folder / "runs" / "self_play", evaluation=None, league=LEAGUE)
    assert said(capsys, "best").splitlines() == ["runs/other", "runs/good"]
    assert said(capsys, "best", "runs/trained").splitlines() == ["runs/trained"]
    assert "no run has a return that can be compared" in said(capsys, "best", "runs/self_play", status=1)
    assert [name for name, run in listed(capsys).items() if run["best"]] == ["runs/good", "runs/other", "runs/trained"]
    parameters = ["environment.parameters={length = 0.7}"]
    record(folder / "runs" / "longer", evaluation=None, settings=parameters, returns=(1.0, 2.0, 3.0))
    assert said(capsys, "best").splitlines() == ["runs/other", "runs/good", "runs/longer"]  # nobody evaluated its task


def test_prune_removes_only_what_is_neither_tagged_nor_best_nor_in_use(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = folder / "runs"
    record(place / "best", evaluation=500.0)
    for name in ("tagged", "running", "own_files", "bad", "worse"):
        record(place / name, evaluation=10.0)
    record(place / "stopped", evaluation=None, finished=False, returns=(1.0, 2.0, 3.0))
    record(place / "self_play", evaluation=None, league=LEAGUE)
    (place / "linked").symlink_to(record(folder / "elsewhere", evaluation=10.0))
    (place / "own_files" / "analysis.ipynb").write_text("{}")
    (place / "notes.txt").write_text("of the user")
    said(capsys, "tag", "paper", "runs/tagged")
    (place / "bad" / "wandb").mkdir()
    before = sorted(folder.rglob("*"))
    with RunLock(place / "running"):
        planned = said(capsys, "prune")
        assert sorted(folder.rglob("*")) == before
        assert [line.split()[1] for line in planned.splitlines() if line.startswith("removes")] == [
            *("runs/bad:", "runs/worse:")
        ]
        reasons = {line.split()[1]: line for line in planned.splitlines() if line.startswith("keeps")}
        assert "it is running" in reasons["runs/running:"]
        assert "tagged paper" in reasons["runs/tagged:"]
        assert "the best of CartPole-v1" in reasons["runs/best:"]
        assert "--unfinished removes it" in reasons["runs/stopped:"]
        assert "such as analysis.ipynb" in reasons["runs/own_files:"]
        assert "it is a link" in reasons["runs/linked:"]
        assert "self-play" in reasons["runs/self_play:"]
        assert "nothing is removed yet; with --yes this would free" in planned
        said(capsys, "prune", "--yes")
    assert sorted(entry.name for entry in place.iterdir()) == sorted(
        ["best", "tagged", "running", "own_files", "stopped", "self_play", "linked", "notes.txt"]
    )
    assert (folder / "elsewhere" / "metrics.csv").exists()
    assert "removes runs/stopped" in said(capsys, "prune", "--unfinished", "--best", "0")
    assert "keeps   runs/stopped: the best of CartPole-v1: 3 (last training" in said(capsys, "prune", "--unfinished")
    said(capsys, "prune", "--yes", "--unfinished", "--best", "0")
    assert not {"stopped", "best"} & {entry.name for entry in place.iterdir()}


def test_a_removal_that_fails_or_was_interrupted_leaves_nothing_unsaid(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        record(folder / "runs" / name, evaluation=1.0 if name == "a" else 2.0)
    (folder / "runs" / ".c.pruned").mkdir()
    with monkeypatch.context() as patch:

        def fail(path: Path, *, ignore_errors: bool = False) -> None:
            if not ignore_errors:
                raise PermissionError(13, "Permission denied")

        patch.setattr("shutil.rmtree", fail)
        error = said(capsys, "prune", "--yes", status=1)
    assert error.rstrip().endswith("/runs/.a.pruned, yourself (Permission denied)")
    assert error.startswith("daedalus runs: runs/a is removed in part")
    monkeypatch.chdir("runs/b")
    said(capsys, "prune", ".", "--best", "0", "--yes")
    assert list((folder / "runs").iterdir()) == []


def test_a_run_that_is_resumed_or_tagged_after_the_plan_is_not_removed(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = record(folder / "runs" / "a")
    with RunLock(run), pytest.raises(RunInUseError, match="is in use by"):
        remove_run(run)
    said(capsys, "tag", "paper", "runs/a")
    with pytest.raises(RunInUseError, match="has got a tag meanwhile"):
        remove_run(run)
    assert listed(capsys)["runs/a"]["tags"] == ["paper"]


def test_a_run_without_locks_is_kept_while_its_heartbeat_is_there(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = record(folder / "runs" / "a")
    monkeypatch.setattr("daedalus.learner.run.run_lock.fcntl", None)  # as on Windows
    (run / "heartbeat").touch()
    with pytest.raises(RunInUseError, match="a learner may be at work"):
        remove_run(run)
    (run / "heartbeat").unlink()
    remove_run(run)
    assert list((folder / "runs").iterdir()) == []


def test_a_run_whose_weights_another_still_needs_is_kept(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "runs" / "best")
    record(folder / "runs" / "source", evaluation=10.0)
    waiting = record(folder / "runs" / "waiting", evaluation=None, finished=False)
    versions = json.loads((waiting / "versions.json").read_text())
    (waiting / "versions.json").write_text(json.dumps({**versions, "init_from": str(folder / "runs" / "source")}))
    assert "keeps   runs/source: runs/waiting begins with its weights" in said(capsys, "prune")
    (waiting / "versions.json").write_text(json.dumps({"init_from": "no path\0"}))
    assert "removes runs/source" in said(capsys, "prune")


def test_a_run_whose_task_is_not_known_is_not_ranked(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        (record(folder / "runs" / name) / "config.toml").write_text("")
    assert said(capsys, "prune", "--best", "0").count("its environment is not known") == 2
    assert "no run has a return that can be compared" in said(capsys, "best", status=1)
