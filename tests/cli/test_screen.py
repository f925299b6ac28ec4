"""cli/screen.py: lines of several threads and a frame share a terminal."""

import importlib.util
import io
import threading
from typing import Any

import pytest
from statuses import actor_status, run_status
from terminal import Terminal, TerminalStream

from daedalus.cli.run_watcher import WatchedRun
from daedalus.cli.screen import Screen


@pytest.fixture(autouse=True)
def size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("LINES", "20")
    monkeypatch.setenv("TERM", "xterm-256color")
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)


def run(env_steps: int, actors: int = 2, **changes: Any) -> WatchedRun:
    members = tuple(actor_status(f"actor-{number}") for number in range(actors))
    return WatchedRun(run_status(env_steps=env_steps, actors=members, **changes))


def seen(stream: io.StringIO) -> Terminal:
    terminal = Terminal(40)
    terminal.feed(stream.getvalue().replace("\n", "\r\n"))  # as the driver of a terminal does
    return terminal


def test_lines_appear_above_the_newest_frame() -> None:
    stream = TerminalStream()
    screen = Screen(stream, stream)
    screen.out("before")
    screen.show([run(100, actors=3)])
    screen.out("one")
    screen.show([run(200)])
    screen.err("two [bold]and[/bold]\x1b[2J")
    screen.show([run(300)])
    screen.end()
    screen.out("after")
    screen.show([run(400)])  # too late
    terminal = seen(stream)
    assert terminal.lines[:4] == ["before", "one", "two [bold]and[/bold]\\x1b[2J", "CartPole-v1, impala  run mine"]
    assert terminal.lines[-2:] == ["after", ""]
    text = "\n".join(terminal.lines)
    assert "env_steps 300" in text
    assert "env_steps 200" not in text
    assert text.count("actor-1") == 1
    assert terminal.cursor_shown
    assert not terminal.wrapped


def test_no_line_is_torn_by_frames_of_another_thread() -> None:
    stream = TerminalStream()
    screen = Screen(stream, stream)
    screen.show([run(0)])

    def write(name: str) -> None:
        for number in range(100):
            screen.out(f"{name} {number} end")

    threads = [threading.Thread(target=write, args=(name,)) for name in ("one", "two")]
    for thread in threads:
        thread.start()
    for number in range(100):
        screen.show([run(number, actors=number % 4, problems=("trouble",) * (number % 3))])
    for thread in threads:
        thread.join()
    screen.end()
    lines = seen(stream).lines
    for name in ("one", "two"):
        assert [line for line in lines if line.startswith(name)] == [f"{name} {number} end" for number in range(100)]
    assert sum("run mine" in line for line in lines) == 1


def test_a_long_line_is_whole_and_does_not_tear_the_frame() -> None:
    stream = TerminalStream()
    screen = Screen(stream, stream)
    screen.show([run(100)])
    screen.out("x" * 100)
    screen.show([run(200)])
    screen.end()
    terminal = seen(stream)
    assert terminal.lines[:4] == ["x" * 40, "x" * 40, "x" * 20, "CartPole-v1, impala  run mine"]
    assert sum("run mine" in line for line in terminal.lines) == 1


def test_the_cursor_is_never_hidden_for_long() -> None:
    """A process that is killed cannot show it again."""
    stream = TerminalStream()
    screen = Screen(stream, stream)
    screen.show([run(100)])
    assert seen(stream).cursor_shown
    screen.end()


def test_the_end_of_training_leaves_a_short_frame() -> None:
    stream = TerminalStream()
    screen = Screen(stream, stream)
    screen.show([run(100)])
    screen.end(run(200))
    text = "\n".join(seen(stream).lines)
    assert "env_steps 200" in text
    assert "actor-" not in text


def test_standard_error_that_is_no_terminal_gets_its_lines() -> None:
    out, err = TerminalStream(), io.StringIO()
    screen = Screen(out, err)
    screen.show([run(100)])
    screen.err("trouble")
    screen.end()
    assert err.getvalue() == "trouble\n"
    assert "trouble" not in out.getvalue()


def test_colours_are_left_out_with_no_color(monkeypatch: pytest.MonkeyPatch) -> None:
    def colours() -> int:
        stream = TerminalStream()
        screen = Screen(stream, stream)
        screen.show([WatchedRun(run_status(problems=("trouble",)))])
        screen.end()
        return stream.getvalue().count("\x1b[33m")

    assert colours()
    monkeypatch.setenv("NO_COLOR", "1")
    assert not colours()


@pytest.mark.parametrize("term", ["dumb", "unknown"])
def test_plain_lines_where_no_frame_can_be_shown(term: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Screen(TerminalStream(), TerminalStream()).shows_frames
    assert not Screen(io.StringIO(), TerminalStream()).shows_frames
    with monkeypatch.context() as changed:
        changed.setattr(importlib.util, "find_spec", lambda name: None)
        assert not Screen(TerminalStream(), TerminalStream()).shows_frames
    monkeypatch.setenv("TERM", term)
    assert not Screen(TerminalStream(), TerminalStream()).shows_frames


def test_a_closed_terminal_does_not_end_the_run() -> None:
    class Closed(TerminalStream):
        def write(self, text: str) -> int:
            raise OSError("closed")

    screen = Screen(Closed(), Closed())
    screen.show([run(100)])
    screen.show([run(200)])
    screen.end()
