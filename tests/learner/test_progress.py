"""learner/reporting/progress.py: one rewritten line on a terminal, a line every few seconds elsewhere."""

import io
from types import SimpleNamespace

import pytest
from league_statuses import LEAGUE
from log_lines import LINES
from terminal import TerminalStream

from daedalus.learner.reporting.metrics_rows import league_columns
from daedalus.learner.reporting.progress import Progress

CLEAR = "\r\x1b[K"


class Clock:
    """Clock that the test sets."""

    now = 100.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("daedalus.learner.reporting.progress.time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> TerminalStream:
    monkeypatch.setenv("COLUMNS", "200")
    return TerminalStream()


def row(env_steps: int, **known: float) -> dict[str, float]:
    return {
        "wall_seconds": 2.0,
        "env_steps": env_steps,
        "env_steps_per_second": 1234.0,
        "updates_per_second": 56.0,
        "policy_lag_mean": 0.75,
        "actors": 2,
        **known,
    }


def test_line_is_rewritten_on_a_terminal(screen: TerminalStream) -> None:
    progress = Progress(screen, 1000)
    progress.show(row(100))
    progress.show(row(200))
    first, second = screen.getvalue().split(CLEAR)[1:]
    assert "100 (10 %)" in first
    assert "200 (20 %)" in second
    assert "\n" not in screen.getvalue()


def test_said_text_is_a_permanent_line_of_its_own(screen: TerminalStream) -> None:
    progress = Progress(screen, 1000)
    progress.say("one")
    progress.show(row(100))
    progress.say("two")
    progress.say("three")
    lines = screen.getvalue().split("\n")
    assert lines[0] == "one"
    assert lines[1].startswith(CLEAR)
    assert lines[2:] == ["two", "three", ""]


def test_end_terminates_the_rewritten_line_once(screen: TerminalStream) -> None:
    progress = Progress(screen, 1000)
    progress.show(row(100))
    progress.end()
    progress.end()
    assert screen.getvalue().count("\n") == 1
    assert screen.getvalue().endswith("\n")


def test_log_gets_a_record_after_1_second_and_then_every_5_seconds_without_a_terminal(clock: Clock) -> None:
    stream = io.StringIO()
    progress = Progress(stream, 1000)
    shown = []
    for tenths in range(0, 121):
        clock.now = 100.0 + tenths / 10
        before = len(LINES)
        progress.show(row(tenths))
        if len(LINES) != before:
            shown.append(tenths)
    assert shown == [10, 60, 110]
    assert "110 (11 %)" in LINES[-1]
    progress.end()
    progress.say("done")
    assert stream.getvalue() == "done\n"


def test_line_shows_the_return_after_the_first_episode(screen: TerminalStream) -> None:
    progress = Progress(screen, 2_000_000)
    progress.show(row(1_500_000))
    assert "return       -" in screen.getvalue()
    progress.show(row(1_500_000, episode_return_mean=475.25))
    line = screen.getvalue().split(CLEAR)[-1]
    for part in ("return   475.2", "1,500,000 (75 %)", "1,234/s", "56/s", "lag 0.8", "actors 2"):
        assert part in line


@pytest.mark.parametrize(("mean", "shown"), [(0.00012, "0.00012"), (-0.034, "-0.034"), (12_345_678.9, "12,345,679")])
def test_line_shows_returns_of_any_size(mean: float, shown: str, screen: TerminalStream) -> None:
    Progress(screen, 2_000_000).show(row(1_500_000, episode_return_mean=mean))
    assert f"return {shown:>7}  " in screen.getvalue()


def test_rates_are_unknown_before_the_first_batch(screen: TerminalStream) -> None:
    Progress(screen, 1000).show({"wall_seconds": 2.0, "env_steps": 0, "actors": 2})
    for part in ("       -/s  left      -  updates     -/s", "lag -  actors 2"):
        assert part in screen.getvalue()


def test_what_the_first_batch_waits_for_stands_in_place_of_figures(screen: TerminalStream) -> None:
    waits_for = "the first batch waits for rollouts: actor-0 is at row 34 of 128"
    Progress(screen, 1000).show({"wall_seconds": 2.0, "env_steps": 0, "actors": 2}, waits_for)
    assert screen.getvalue().endswith(f"    2.0 s  {waits_for}  actors 2")


def test_lag_is_shown_in_batches_where_a_batch_makes_several_updates(screen: TerminalStream) -> None:
    Progress(screen, 1000, 160).show(row(100, policy_lag_mean=160.0))
    assert "lag 1 batch (160 updates)" in screen.getvalue()


@pytest.mark.parametrize("columns", [20, 60, 80, 100, 200])
def test_line_fits_the_terminal(columns: int, screen: TerminalStream, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    Progress(screen, 2_000_000).show(row(1_500_000, episode_return_mean=-1234.5, episode_length_mean=1000.0))
    line = screen.getvalue().removeprefix(CLEAR)
    assert len(line) < columns
    for part, needed in (("return -1234.5", 30), ("1,500,000 (75 %)", 60), ("left", 80), ("length  1,000", 100)):
        assert (part in line) == (columns >= needed), part


def test_small_rates_are_not_shown_as_0(screen: TerminalStream) -> None:
    Progress(screen, 10_000).show(row(464, env_steps_per_second=0.4, updates_per_second=0.0293))
    line = screen.getvalue().split(CLEAR)[-1]
    for part in ("    0.4/s", "left  6.6 h", "updates 0.029/s"):
        assert part in line


def test_a_rating_stands_in_place_of_a_return_that_is_0_by_construction(screen: TerminalStream) -> None:
    Progress(screen, 1000).show(row(100, episode_return_mean=0.0, **league_columns(LEAGUE)))
    assert "rating  1,312 +- 50  wins against my_bots.Greedy 75%, random 97%" in screen.getvalue()
    assert "return" not in screen.getvalue()
