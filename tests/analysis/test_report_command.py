"""Test of `daedalus report`: what the file shows, and that nothing in a run directory becomes markup."""

import copy
import csv
import json
import os
import pickle
import re
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from recorded_runs import record

from daedalus.analysis import run_report
from daedalus.cli.commands.report import report
from daedalus.learner.serving.events import EventFile
from daedalus.policy.saving.sealed import write_sealed
from daedalus.protocol.messages import Event

HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)>\"'&\u202e\x00"
RETURNS = [400.0, 480.0, 490.0, 500.0, 500.0, 500.0, 500.0, 100.0]
GIF = (
    b"GIF89a\x01\x00\x01\x00\x80\x00\x00\x00\x00\x00\xff\xff\xff,\x00\x00\x00\x00\x01\x00\x01\x00\x00\x02\x02D\x01\x00;"
)


@pytest.fixture(scope="module", autouse=True)
def drawn_once() -> Iterator[None]:
    """Draw equal charts once: most tests are about the rest of the page, and matplotlib takes most of the time."""
    drawn: dict[bytes, ET.Element] = {}

    def once(draw: Callable[..., ET.Element]) -> Callable[..., ET.Element]:
        def chart(*arguments: Any, **options: Any) -> ET.Element:
            key = pickle.dumps((draw.__name__, arguments, options))
            if key not in drawn:
                drawn[key] = draw(*arguments, **options)
            return copy.deepcopy(drawn[key])

        return chart

    with pytest.MonkeyPatch.context() as patch:
        for draw in (run_report.line_chart, run_report.histogram):
            patch.setattr(run_report, draw.__name__, once(draw))
        yield


def evaluated(directory: Path, returns: Sequence[float] = RETURNS, **changes: Any) -> Path:
    """Write evaluation.json as `daedalus evaluate --json` prints it."""
    mean = sum(returns) / len(returns)
    content = {
        "environment": "CartPole-v1",
        "backend": "gymnasium",
        "checkpoint": "checkpoints/0000000001",
        "best_checkpoint": True,
        "policy_version": 128,
        "episodes": len(returns),
        "notes": [],
        "return_mean": mean,
        "return_std": (sum((each - mean) ** 2 for each in returns) / len(returns)) ** 0.5,
        "return_min": min(returns),
        "return_max": max(returns),
        "length_mean": 433.75,
        "returns": list(returns),
        "lengths": [int(each) for each in returns],
        "seed": 7,
        "actions": "greedy",
    }
    (directory / "evaluation.json").write_text(json.dumps({**content, **changes}))
    return directory


def happened(directory: Path, *events: tuple[str, str, str]) -> None:
    file = EventFile(directory)
    for kind, actor, text in events:
        event = {"time": "2026-11-22T10:15:00.250Z", "kind": kind, "actor": actor, "text": text, "count": 1}
        file.add([Event.model_validate(event)])


class Page(HTMLParser):
    """The tags, attributes and texts of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.text = ""
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_data(self, data: str) -> None:
        self.text += f" {data}"


def test_a_report_shows_evaluation_curves_settings_and_versions(folder: Path) -> None:
    run = evaluated(record(folder / "run", solved=True, wall_seconds=180.0, updates=42, evaluation=433.75))
    assert report(["run"]) == 0
    text = " ".join(Page(run / "report.html").text.split())
    assert "run solved CartPole-v1 · " in text
    played = "8 greedy episodes of the best checkpoint, policy version 128, on CartPole-v1 (backend gymnasium), seed"
    assert played in text
    assert "mean 433.8 95 % interval of the mean" in text
    assert "interquartile mean 492.5 95 % bootstrap interval" in text  # of 480, 490, 500, 500
    assert "lowest and highest 100 to 500" in text
    assert "duration 3.0 min" in text
    assert "return of the training episodes" in text
    assert "entropy (nats)" in text
    assert "target_return 475" in text
    assert "gymnasium 1." in text
    assert "Nothing that the run directory records failed." in text
    assert "daedalus train run/config.toml" in text


def test_the_return_is_first(folder: Path) -> None:
    run = evaluated(record(folder / "run"))
    assert report(["run"]) == 0
    page = (run / "report.html").read_text()
    sections = re.findall(r"<h2>([^<]*)</h2>", page)
    assert sections[:3] == ["Return", "Evaluation", "Learning curves"]
    assert (
        page.index("return of the training episodes") < page.index("episodes by return") < page.index("entropy (nats)")
    )


def test_settings_that_are_the_defaults_are_collapsed(folder: Path) -> None:
    run = record(folder / "run", settings=["collection.window=7"])
    assert report(["run"]) == 0
    chosen, others = (run / "report.html").read_text().split("settings at their defaults")
    shown, hidden = (
        re.findall(r'<th scope="row">(\w+)</th>', part) for part in (chosen, others.split("</details>")[0])
    )
    assert {"id", "window", "target_return", "learning_rate"} <= set(shown)
    assert {"discount_factor", "action_repeat"} <= set(hidden)
    assert not {"discount_factor", "action_repeat"} & set(shown)
    assert not {"id", "window"} & set(hidden)


def test_commands_allow_the_modules_of_a_run_and_begin_with_its_weights(folder: Path) -> None:
    settings = ["environment.id=corridor:Corridor-v0", "policy.encoder=layers:Net"]
    run = record(folder / "run", settings=settings, evaluation=None, finished=False)
    versions = json.loads((run / "versions.json").read_text())
    origin = {"init_from": "/runs/first one", "init_from_other_spaces": True}
    (run / "versions.json").write_text(json.dumps({**versions, **origin}))
    write_sealed(run / "demonstrations" / "00000000", {}, {"dataset": "pen human"})
    assert report(["run"]) == 0
    text = Page(run / "report.html").text
    train = "daedalus train run/config.toml --init-from '/runs/first one' --allow-other-spaces"
    train += " --demonstrations 'pen human'"
    assert f"{train}\ndaedalus evaluate run --allow-module corridor The run has code" in text
    assert "daedalus evaluate run --allow-module corridor --record" in text
    assert "continue it with: daedalus resume run --allow-module corridor --allow-module layers" in text


def test_a_histogram_counts_the_episodes(folder: Path) -> None:
    run = evaluated(record(folder / "run"), [0.0, 0.0, 0.0, 10.0])
    assert report(["run"]) == 0
    page = (run / "report.html").read_text()
    bars = re.findall(r'<path d="([^"]*)"[^>]*fill: var\(--bar\)', page)
    heights = [np.ptp([float(point) for point in re.findall(r"[ML] [-\d.]+ ([-\d.]+)", bar)]) for bar in bars]
    assert sum(height > 0.0 for height in heights) == 2
    assert heights[0] == pytest.approx(3 * heights[-1], abs=0.2)


def test_a_run_without_an_evaluation_says_how_to_evaluate_it(folder: Path) -> None:
    run = record(folder / "run", evaluation=None)
    assert report(["run"]) == 0
    text = Page(run / "report.html").text
    assert "No evaluation is recorded. Evaluate the run with:" in text
    assert "daedalus evaluate run --record" in text


def test_a_run_of_an_earlier_release_has_an_evaluation_without_a_histogram(folder: Path) -> None:
    run = evaluated(record(folder / "run"))
    evaluation = json.loads((run / "evaluation.json").read_text())
    (run / "evaluation.json").unlink()
    del evaluation["returns"], evaluation["lengths"]
    summary = json.loads((run / "summary.json").read_text())
    (run / "summary.json").write_text(json.dumps({**summary, "evaluation": evaluation}))
    assert report(["run"]) == 0
    text = " ".join(Page(run / "report.html").text.split())
    assert "mean 433.8" in text
    assert "The returns of the episodes are not recorded, so there is no histogram." in text


def test_nothing_in_a_run_directory_becomes_markup(folder: Path) -> None:
    name = "<b>run" if os.name != "nt" else "run"
    run = evaluated(
        record(folder / name, rollouts_rejected={HOSTILE: 3}),
        notes=[HOSTILE],
        backend=HOSTILE,
        actions=HOSTILE,
    )
    settings = tomllib.loads((run / "config.toml").read_text())
    settings["environment"]["kwargs"] = {"map": HOSTILE}
    (run / "config.toml").write_text(tomli_w.dumps(settings))
    happened(run, ("started", "", "serving"), ("rejected", HOSTILE, HOSTILE))
    (run / "output.log").write_text(HOSTILE)
    (run / "versions.json").write_text(json.dumps({HOSTILE: HOSTILE, "lone": "\ud800"}))
    metrics = (run / "metrics.csv").read_text().splitlines()
    column = '"env/' + HOSTILE.replace('"', '""').replace("\x00", "") + '"'
    (run / "metrics.csv").write_text(
        "\n".join([f"{metrics[0]},{column}", *(f"{line},1" for line in metrics[1:])]) + "\n"
    )
    assert report([name]) == 0
    assert report([name, name, "--output", "again.html"]) == 0
    record(folder / "other")
    assert report([name, "other"]) == 0
    for file in (run / "report.html", folder / "report.html"):
        page = Page(file)
        assert not {"script", "b"} & set(page.tags)
        assert page.tags.count("img") == 0
        assert not [attribute for attribute, _ in page.attributes if attribute.startswith("on")]
    assert Page(run / "report.html").text.count("<script>alert(1)</script>") >= 8


def test_a_report_names_no_other_host(folder: Path) -> None:
    run = evaluated(record(folder / "run"))
    (run / "replay.gif").write_bytes(GIF)
    assert report(["run"]) == 0
    page = Page(run / "report.html")
    assert not re.findall(
        r"https?:|//", "".join(value for _, value in page.attributes if not value.startswith("data:"))
    )
    (policy,) = [value for _, value in page.attributes if value.startswith("default-src")]
    assert policy.startswith("default-src 'none';")


def test_the_newest_video_is_embedded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = record(folder / "run")
    (run / "old.gif").write_bytes(b"GIF89a")
    os.utime(run / "old.gif", (1, 1))
    (run / "replay.mp4").write_bytes(b"a video")
    assert report(["run"]) == 0
    assert ("src", "data:video/mp4;base64,YSB2aWRlbw==") in Page(run / "report.html").attributes
    monkeypatch.setattr(run_report, "MAX_VIDEO_BYTES", 3)
    assert report(["run"]) == 0
    page = Page(run / "report.html")
    assert "video" not in page.tags
    assert "record a shorter one with --max-seconds" in page.text


def test_a_video_that_is_a_link_is_left_out(folder: Path) -> None:
    run = record(folder / "run")
    (folder / "secret").write_bytes(b"secret")
    (run / "replay.mp4").symlink_to(folder / "secret")
    (run / "output.log").symlink_to(folder / "secret")
    assert report(["run"]) == 0
    page = Page(run / "report.html")
    assert "video" not in page.tags
    assert "secret" not in page.text


FILES = ("config.toml", "summary.json", "metrics.csv", "evaluation.json", "versions.json", "events.jsonl")


def refused(directory: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return why there is no report of a run, without the name of the run."""
    assert report([directory.name]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err.strip().removeprefix(f"daedalus report: {directory.name}/")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no FIFOs in folders")
class TestFileThatIsNotRegular:
    """A FIFO never ends, nor does a device such as /dev/zero, and reading a FIFO waits for a writer."""

    @pytest.mark.parametrize("name", FILES)
    def test_fifo(self, folder: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
        run = record(folder / "run")
        (run / name).unlink(missing_ok=True)
        os.mkfifo(run / name)
        assert refused(run, capsys) == f"{name}: not a regular file"

    @pytest.mark.parametrize("name", FILES)
    def test_link_to_a_device(self, folder: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
        run = record(folder / "run")
        (run / name).unlink(missing_ok=True)
        (run / name).symlink_to("/dev/zero")
        assert refused(run, capsys) == f"{name}: not a regular file"

    def test_log(self, folder: Path) -> None:
        run = record(folder / "run")
        os.mkfifo(run / "output.log")
        assert report(["run"]) == 0
        assert "printed last" not in Page(run / "report.html").text


@pytest.mark.parametrize("name", ["summary.json", "evaluation.json", "versions.json"])
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("[" * 200_000, "is damaged: it is not valid JSON; delete the file"),
        ('{"a": ' + "[" * 200 + "]" * 200 + "}", "is not valid: its values are nested too deeply"),
        ('{"a": 1' + "0" * 4000 + "}", "is not valid: it has an integer of more than 64 bits"),
    ],
    ids=["depth beyond Python's limit", "depth", "integer"],
)
def test_excessive_json_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str, content: str, reason: str
) -> None:
    run = record(folder / "run")
    (run / name).write_text(content)
    assert refused(run, capsys) == f"{name} {reason}"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("a = " + "[" * 20_000, ": its values are nested too deeply"),
        (f"[environment.kwargs.{'.'.join('a' * 50_000)}]", ": its values are nested too deeply"),
        ("[environment.kwargs]\na = 0x" + "f" * 9000, ": it has an integer of more than 64 bits"),
        ("a = 1" + "0" * 9000, " TOML: Exceeds the limit (4300 digits) for integer string conversion"),
    ],
    ids=["lists", "tables", "integer", "digits"],
)
def test_excessive_settings_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], content: str, reason: str
) -> None:
    run = record(folder / "run")
    (run / "config.toml").write_text(content)
    assert refused(run, capsys).startswith(f"config.toml is not valid{reason}")


def test_file_that_is_larger_than_any_of_a_run_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = record(folder / "run")
    os.truncate(run / "config.toml", (1 << 20) + 1)
    assert refused(run, capsys) == "config.toml is larger than 1 MiB, the limit for such a file of a run"


def test_dates_in_the_settings_of_another_release_are_shown(folder: Path) -> None:
    run = record(folder / "run")
    with open(run / "config.toml", "a") as file:
        file.write("[other_release]\nbegin = 2026-11-22\n")
    assert report(["run"]) == 0
    assert "begin 2026-11-22" in " ".join(Page(run / "report.html").text.split())


def test_failures_are_counted_and_listed(folder: Path) -> None:
    causes = {"stale": 3, "malformed": 1}
    run = record(folder / "run", rollouts_rejected=causes, rollouts_accepted=396, updates_skipped=2)
    happened(
        run,
        ("started", "", "serving run"),
        ("joined", "arm-7", "joined with 8 environments"),
        ("left", "arm-7", "no longer connected"),
        ("left", "arm-7", "no longer connected"),
        ("checkpoint", "", "checkpoint saved at 1,000 env_steps: somewhere"),
        ("checkpoint", "", "checkpoint not saved: no space left on device"),
        ("started", "", "serving run"),
        ("ended", "", "finished"),
        ("left", "arm-8", "no longer connected"),
    )
    EventFile(run).add_restart("actor-1 was killed by signal 9; started again")
    assert report(["run"]) == 0
    text = " ".join(Page(run / "report.html").text.split())
    for words in (
        "learner started again 1 ",
        "process restarted by the launcher 1 ",
        "actor lost or gone 2 before the end of the run",
        "rollout rejected 4 1 % of all: malformed 1, stale 3",
        "update skipped 2 gradient not finite",
        "checkpoint not saved 1",
        "arm-7 no longer connected 2",
        "restarted actor-1 was killed by signal 9; started again",
    ):
        assert words in text
    assert "arm-8" not in text
    assert "checkpoint saved at" not in text


def test_several_runs_are_one_page_with_a_table_and_curves_together(folder: Path) -> None:
    for length, mean in ((5, 490.0), (64, 400.0)):
        for seed in (1, 2):
            settings = (f"collection.rollout_length={length}",)
            record(folder / f"runs/{length}-{seed}", seed=seed, settings=settings, evaluation=mean + seed)
    record(folder / "runs/other", seed=3, settings=("collection.rollout_length=5",), finished=False, evaluation=None)
    assert report(["runs"]) == 0
    page = Page(folder / "report.html")
    text = " ".join(page.text.split())
    assert "5 runs of CartPole-v1" in text
    assert "rollout_length=5 2 491.5 [491.0, 492.0] 2 of 2" in text
    assert "rollout_length=64 2 401.5 [401.0, 402.0] 2 of 2" in text
    assert "rollout_length=5 (3 runs)" in text
    assert "rollout_length=64 (2 runs)" in text
    assert "runs/other is not finished" in text
    assert "collection.rollout_length 5 64" in text
    html = (folder / "report.html").read_text()
    colours = re.findall(r'style="fill: none; stroke: var\(--(series-\d)\)', html)
    assert colours[:2] == ["series-1", "series-2"]
    assert colours.count("series-1") == colours.count("series-2") >= 4


def test_runs_of_several_environments_have_tables_and_charts_of_their_own(folder: Path) -> None:
    for name, preset in (("a", "cartpole"), ("b", "cartpole"), ("c", "acrobot")):
        record(folder / "runs" / name, preset=preset, seed=ord(name))
    assert report(["runs"]) == 0
    text = " ".join(Page(folder / "report.html").text.split())
    assert "3 runs of 2 environments" in text
    acrobot, cartpole = text.index("Acrobot-v1 Return"), text.index("CartPole-v1 Return")
    assert acrobot < text.index("c 1 490", acrobot) < cartpole < text.index("CartPole-v1, impala 2 490", cartpole)
    html = (folder / "report.html").read_text()
    assert html.count(">return of the training episodes<") == 2
    clips = re.findall(r'<clipPath id="([^"]+)"', html)
    assert len(set(clips)) == len(clips)  # a chart does not refer to parts of another


def test_a_run_that_cannot_be_read_is_left_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder / "runs/a")
    (record(folder / "runs/b") / "metrics.csv").unlink()
    assert report(["runs", "--output", "both.html"]) == 0
    expected = "left out: runs/b has no metrics yet: wait until the run has made its first updates"
    assert capsys.readouterr().err == f"daedalus report: {expected}\n"
    assert expected in Page(folder / "both.html").text


def test_a_run_whose_evaluation_is_damaged_is_left_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluated(record(folder / "runs/a"))
    (record(folder / "runs/b", seed=2) / "evaluation.json").write_text("")
    assert report(["runs", "--output", "both.html"]) == 0
    expected = "left out: runs/b/evaluation.json is damaged: it is not valid JSON; delete the file"
    assert capsys.readouterr().err == f"daedalus report: {expected}\n"
    assert expected in Page(folder / "both.html").text


def test_the_evaluation_of_one_episode_has_no_interval(folder: Path) -> None:
    run = evaluated(record(folder / "run"), [7.0])
    assert report(["run"]) == 0
    assert "95 % interval -" not in Page(run / "report.html").text


@pytest.mark.parametrize("name", ["env_steps", "wall_seconds"])
def test_numbers_of_a_hostile_run_that_cannot_be_drawn_are_refused_or_left_out(
    folder: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = record(folder / "run")
    for values in (["-1e308", "1e308", "1e308"], ["", "", ""]):
        rows = list(csv.DictReader((run / "metrics.csv").read_text().splitlines()))
        changed = [{**row, name: value} for row, value in zip(rows, values, strict=True)]
        changed = [{**row, "evaluation_env_steps": "2000", "evaluation_return_mean": "9"} for row in changed]
        with open(run / "metrics.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, list(changed[0]))
            writer.writeheader()
            writer.writerows(changed)
        for by in ("env_steps", "minutes"):
            if name == "env_steps":  # without which nothing has a place
                assert report(["run", "--by", by]) == 1
                assert "env_steps has a value that is no number of steps" in capsys.readouterr().err
            else:
                assert report(["run", "--by", by]) == 0
                assert not re.search(r'd="[^"]*(nan|inf)', (run / "report.html").read_text())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere does not exist: name a run directory, or a folder of run directories"),
        (["empty"], "empty is not a run directory: it has neither config.toml nor metrics.csv; name a run directory"),
        (["fresh"], "fresh has no metrics yet: wait until the run has made its first updates"),
        (["text"], "text/summary.json is damaged: env_steps is not a number"),
        (["damaged"], "damaged/evaluation.json is damaged (return_mean: "),
        (["broken"], "broken/versions.json is damaged: it is not valid JSON; delete the file"),
        (["run", "--output", "no/report.html"], "no/report.html: No such file or directory; choose another file with"),
    ],
)
def test_bad_input_is_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    record(folder / "run")
    record(folder / "text", env_steps=(1, 2, 3)).joinpath("summary.json").write_text('{"env_steps": "3"}')
    evaluated(record(folder / "damaged"), return_mean="NaN")
    (record(folder / "broken") / "versions.json").write_text("{")
    (record(folder / "fresh") / "metrics.csv").unlink()
    (folder / "empty").mkdir()
    assert report(words) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith(f"daedalus report: {message}")


@pytest.mark.parametrize("values", [["inf", "-inf", "nan"], ["1e308", "-1e308", "1e308"], ["1e-310", "2e-310", "0"]])
def test_numbers_that_cannot_be_drawn_are_left_out(folder: Path, values: list[str]) -> None:
    run = record(folder / "run")
    header, *rows = (run / "metrics.csv").read_text().splitlines()
    rows = [f"{row},{value}" for row, value in zip(rows, values, strict=True)]
    (run / "metrics.csv").write_text("\n".join([f"{header},user/wild", *rows]) + "\n")
    assert report(["run"]) == 0
    assert not re.search(r'd="[^"]*(nan|inf)', (run / "report.html").read_text())


def test_a_report_shows_no_password_also_of_a_run_of_an_earlier_release(folder: Path) -> None:
    run = record(folder / "secretive")
    secret = "mlflow: http://ada:pa55w0rd@host refused"
    settings = tomllib.loads((run / "config.toml").read_text())
    settings["environment"]["kwargs"] = {"at": secret}
    (run / "config.toml").write_text(tomli_w.dumps(settings))
    happened(run, ("started", "", "serving"), ("failed", "a", secret))
    (run / "output.log").write_text(secret)
    assert report(["secretive"]) == 0
    page = (run / "report.html").read_text()
    assert page.count("http://***@host") == 3
    assert "pa55w0rd" not in page
