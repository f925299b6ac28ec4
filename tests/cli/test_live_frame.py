"""cli/live_frame.py: the curve, the rates and the frame of a run."""

import io

import numpy as np
import pytest
from league_statuses import LEAGUE
from rich.console import Console
from statuses import actor_status, run_status

from daedalus.cli.live_frame import ASCII, frame, sparkline, summary_frame
from daedalus.cli.run_watcher import WatchedRun
from daedalus.protocol.messages import MetricsPage, MetricsReport, RunStatus


def watched(status: RunStatus, *returns: float) -> WatchedRun:
    run = WatchedRun(status)
    run.add_status(status)
    run.curve = list(returns)
    return run


def drawn(*runs: WatchedRun, width: int = 80, height: int = 24, ascii_only: bool = False) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=height, force_terminal=True, color_system=None)
    console.print(frame(runs, width, height, ascii_only=ascii_only))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()


def actors(count: int) -> RunStatus:
    return run_status(actors=tuple(actor_status(f"actor-{number}") for number in range(count)))


@pytest.mark.parametrize(
    ("values", "width", "shown"),
    [
        ([], 10, ""),
        ([1.0], 10, "▁"),
        ([0.0, 7.0], 10, "▁█"),
        ([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], 10, "▁▂▃▄▅▆▇█"),
        ([0.0, 2.0, 5.0, 9.0], 2, "▁█"),
        ([5.0] * 100, 3, "▁▁▁"),
        ([1.0, 2.0], 0, ""),
    ],
)
def test_a_curve_spans_the_values(values: list[float], width: int, shown: str) -> None:
    assert sparkline(values, width) == shown
    assert sparkline(values, width, ASCII).isascii()


def test_a_run_keeps_the_returns_of_all_rows_and_knows_its_end() -> None:
    run = WatchedRun(run_status(env_steps=100))
    run.add_status(run_status(env_steps=400, env_steps_per_second=30.0))
    assert run.seconds_left == 20.0
    page = MetricsPage(run="mine", learner_epoch=1, columns=("env_steps", "episode_return_mean"))
    values = np.array([[1.0, np.nan], [2.0, 5.0], [3.0, 6.0]])
    run.add_rows(MetricsReport(page=page, numbers=np.array([0, 1, 4]), values=values))
    assert (run.curve, run.next_row) == ([5.0, 6.0], 5)
    for _ in range(3000):
        run.add_rows(MetricsReport(page=page, numbers=np.array([5, 6, 7]), values=values))
    assert len(run.curve) <= 4096


def test_a_frame_shows_progress_return_and_actors() -> None:
    status = run_status(
        episode_return_mean=474.25,
        env_steps=250,
        actors=(actor_status("arm-1"), actor_status("arm-2", alive=False), actor_status("arm-3", quarantined="NaN")),
    )
    text = "\n".join(drawn(watched(status, 1.0, 2.0, 9.0), width=100))
    for part in ("CartPole-v1, impala  run mine", "25%  left   38 s", "474.2  ▁▂█", "env_steps 250  20/s  of 1,000"):
        assert part in text
    rows = [line.split() for line in text.splitlines() if line.startswith("arm-")]
    assert [row[:2] for row in rows] == [["arm-1", "alive"], ["arm-2", "gone"], ["arm-3", "quarantined"]]


def test_a_frame_of_a_game_with_opponents_shows_ratings() -> None:
    run = WatchedRun(run_status(league=LEAGUE, episode_return_mean=0.0))
    page = MetricsPage(run="mine", learner_epoch=1, columns=("env_steps", "rating", "episode_return_mean"))
    run.add_rows(
        MetricsReport(page=page, numbers=np.array([0, 1]), values=np.array([[1.0, 3.0, 0.0], [2.0, 5.0, 0.0]]))
    )
    text = "\n".join(drawn(run))
    assert "rating    1,312 +- 50  ▁█" in text
    assert "newest wins against  my_bots:Greedy 75%  random 97%" in text


@pytest.mark.parametrize("width", [20, 40, 60, 80, 200])
@pytest.mark.parametrize("height", [2, 8, 24])
def test_a_frame_fits_the_terminal(width: int, height: int) -> None:
    status = actors(30).model_copy(
        update={
            "actors": tuple(actor_status(f"{'actor' * 12}-{number}") for number in range(30)),
            "run": "r" * 60,
            "environment": "e" * 60,
            "problems": ("p" * 300,),
            "env_steps": 10**12,
            "league": LEAGUE,
        }
    )
    run = watched(status, *map(float, range(500)))
    run.curve[0] = -1e9
    lines = drawn(run, width=width, height=height)
    assert max(map(len, lines)) <= width
    assert len(lines) <= max(height - 1, 8)
    assert width < 40 or lines[2].endswith("█")  # the newest part of the curve
    if height == 24:
        assert lines[-1] == "... and 16 more"
        assert sum("actoractor" in line for line in lines) == 14


def test_a_narrow_terminal_shows_the_most_important_columns() -> None:
    run = watched(actors(2), 1.0, 2.0)
    header = next(line for line in drawn(run, width=40) if "state" in line)
    assert header.split() == ["actor", "state", "/s"]
    assert "gpu-box" in "\n".join(drawn(run, width=100))


def test_texts_of_peers_are_neither_markup_nor_commands() -> None:
    name = "[red]x[/red]\x1b]0;owned\x07\n:smile:"
    status = run_status(actors=(actor_status(name),), problems=("a\x9b31m\nb",), environment="[bold]E")
    text = "\n".join(drawn(watched(status), width=120))
    assert "[red]x[/red]\\x1b]0;owned\\x07 :smile:" in text
    assert "PROBLEM: a\\x9b31m b" in text
    assert "[bold]E" in text


def test_two_runs_share_the_lines() -> None:
    lines = drawn(watched(actors(30)), watched(actors(30)), height=30)
    assert len(lines) <= 29
    assert sum("more" in line for line in lines) == 2


def test_the_last_frame_has_no_actors() -> None:
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system=None)
    console.print(summary_frame(watched(actors(3)), 80))
    assert isinstance(console.file, io.StringIO)
    assert "actor-" not in console.file.getvalue()


def test_a_terminal_without_unicode_gets_ascii() -> None:
    console = Console(file=io.TextIOWrapper(io.BytesIO(), "ascii"), width=80, force_terminal=True, color_system=None)
    console.print(frame([watched(actors(1), 1.0, 2.0)], 80, 24, ascii_only=console.options.ascii_only))
    assert console.options.ascii_only
