"""cli/run_watcher.py: a live display queries the learner again and again, and outlasts its restarts."""

import io
import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_lines import LINES
from processes import LIMIT, until
from recorded_runs import record
from statuses import actor_status, run_status
from terminal import Terminal, TerminalStream

from daedalus.analysis.run_selection import change_tag
from daedalus.cli import screen
from daedalus.cli.commands import status as status_module
from daedalus.cli.commands.status import status as status_command
from daedalus.cli.run_watcher import looks
from daedalus.cli.screen import Screen, TrainingDisplay
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.messages import MetricsPage, MetricsReport, MetricsRequest, RunStatus, StatusReport
from daedalus.transport.interface import Request, Transport, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class Learner:
    """Learner that reports `status`, and as many rows of metrics as `returns` has."""

    def __init__(self, **changes: Any) -> None:
        self.network = MemoryNetwork()
        self.status: RunStatus = run_status(actors=(actor_status("arm-1"),), **changes)
        self.returns = [1.0, 2.0, 3.0]
        self.asked: list[int] = []  # first rows
        self.transport = MemoryTransport(self.network)
        self.transport.serve(keys.status(self.status.run), self._answer)

    def _answer(self, request: Request) -> None:
        asked = decode(request.payload, LEARNER_LIMITS) if request.size else None
        if not isinstance(asked, MetricsRequest):
            request.reply(encode(StatusReport(status=self.status)))
            return
        self.asked.append(asked.first)
        page = MetricsPage(
            run=self.status.run, learner_epoch=self.status.learner_epoch, columns=("episode_return_mean",)
        )
        values = np.array(self.returns[asked.first :], np.float64).reshape(-1, 1)
        numbers = np.arange(asked.first, len(self.returns))
        request.reply(encode(MetricsReport(page=page, numbers=numbers, values=values)))

    def connect(self, *_: object) -> Transport:
        return MemoryTransport(self.network)


@pytest.fixture
def tty(monkeypatch: pytest.MonkeyPatch) -> TerminalStream:
    for name, value in {"COLUMNS": "100", "LINES": "20", "TERM": "xterm"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(screen, "_LOOK_SECONDS", 0.01)
    monkeypatch.setattr(screen, "_FIRST_SECONDS", 0.0)
    return TerminalStream()


def seen(stream: io.StringIO) -> str:
    terminal = Terminal(100)
    terminal.feed(stream.getvalue().replace("\n", "\r\n"))
    return "\n".join(terminal.lines)


def test_each_row_is_queried_once_and_a_restarted_learner_from_the_first() -> None:
    learner, stop = Learner(), threading.Event()
    watching: Iterator[Any] = looks(learner.connect, "mine", stop, 0.0)
    (run,) = next(watching)
    assert run.curve == [1.0, 2.0, 3.0]
    learner.returns.append(4.0)
    (run,) = next(watching)
    assert run.curve == [1.0, 2.0, 3.0, 4.0]
    assert learner.asked == [0, 3, 3, 4]
    learner.status = learner.status.model_copy(update={"learner_epoch": 2})
    (run,) = next(watching)
    assert learner.asked[4:] == [0, 4]
    stop.set()
    assert not list(watching)


def test_looks_are_empty_until_a_learner_answers_and_after_it_has_gone() -> None:
    learner, stop = Learner(), threading.Event()
    faults = [TransportError("nobody there")] * 2

    def connect() -> Transport:
        if faults:
            raise faults.pop()
        return learner.connect()

    watching = looks(connect, keys.ANY_RUN, stop, 0.0)
    assert [len(next(watching)) for _ in range(4)] == [0, 0, 1, 1]
    learner.transport.close()
    assert [len(next(watching)) for _ in range(3)] == [0, 0, 0]
    stop.set()


def test_status_watch_redraws_a_frame_until_ctrl_c(tty: TerminalStream, monkeypatch: pytest.MonkeyPatch) -> None:
    learner, frames = Learner(), []

    class Interrupted(Screen):
        def show(self, runs: Any) -> None:
            super().show(runs)
            frames.append(runs)
            if len(frames) == 3:
                raise KeyboardInterrupt

    monkeypatch.setattr(status_module, "_FRAME_SECONDS", 0.0)
    monkeypatch.setattr(status_module, "connect_once", learner.connect)
    monkeypatch.setattr(status_module, "Screen", lambda: Interrupted(tty, tty))
    assert status_command(["--connect", "tcp/127.0.0.1:7447", "--watch"]) == 0
    shown = seen(tty)
    assert shown.count("run mine") == 1
    assert "return     20.0  ▁▅█" in shown
    assert "arm-1" in shown


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_status_watch_prints_lines_elsewhere(
    options: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    learner, looked = Learner(), []

    def connect(*_: object) -> Transport:
        looked.append(1)
        if len(looked) <= 2:
            raise TransportError("nobody there")
        if len(looked) > 3:
            raise KeyboardInterrupt
        return learner.connect()

    def interrupted(status: RunStatus) -> str:
        learner.transport.close()
        return original(status)

    name = "_json" if options else "_text"
    original: Callable[[RunStatus], str] = getattr(status_module, name)
    monkeypatch.setattr(status_module, name, interrupted)
    monkeypatch.setattr(status_module, "_TEXT_SECONDS", 0.0)
    monkeypatch.setattr(status_module, "connect_once", connect)
    assert status_command(["--connect", "tcp/127.0.0.1:7447", "--watch", *options]) == 0
    printed = capsys.readouterr()
    reasons = ("nobody there", "no learner answers at this address")  # before and after
    assert printed.err.splitlines() == [f"daedalus status: {each}; waiting for one (Ctrl-C ends)" for each in reasons]
    if options:
        assert json.loads(printed.out)["run"] == "mine"
    else:
        assert printed.out.startswith("run mine: CartPole-v1")
    assert "\x1b" not in printed.out


@pytest.mark.parametrize("option", ["--events", "--quiet"])
def test_watch_shows_nothing_but_the_state(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        status_command(["--connect", "tcp/127.0.0.1:7447", "--watch", option])
    assert "leave out" in capsys.readouterr().err


@pytest.fixture
def display(tty: TerminalStream) -> TrainingDisplay:
    return TrainingDisplay(Screen(tty, tty), "mine")


def test_train_shows_its_run_and_at_the_end_a_short_frame(
    display: TrainingDisplay, tty: TerminalStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = Learner()
    monkeypatch.setattr("daedalus.transport.connecting.connect", learner.connect)
    display.begin("unixsock-stream//nowhere")
    assert not display.poll(None)  # type: ignore[arg-type]
    until(lambda: "arm-1" in tty.getvalue())
    learner.status = learner.status.model_copy(update={"env_steps": 777})
    until(lambda: "777" in tty.getvalue())
    display.end()
    assert "env_steps 777" in seen(tty)
    assert "arm-1" not in seen(tty)


def test_a_fault_of_the_display_does_not_disturb_training(
    display: TrainingDisplay, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = Learner()
    monkeypatch.setattr("daedalus.transport.connecting.connect", learner.connect)
    monkeypatch.setattr("daedalus.cli.live_frame._head", lambda *_: 1 / 0)
    display.begin("unixsock-stream//nowhere")
    display.poll(None)  # type: ignore[arg-type]
    assert display._thread is not None
    display._thread.join(LIMIT)
    display.end()
    assert LINES == ["the display has ended: ZeroDivisionError: division by zero; training continues"]


def test_a_tag_shows_the_runs_whose_directories_have_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    learner, other = Learner(run="mine"), Learner(run="theirs")
    other.transport.close()
    other.transport = MemoryTransport(learner.network)
    other.transport.serve(keys.status("theirs"), other._answer)
    monkeypatch.setattr(status_module, "connect_once", learner.connect)
    for name in ("mine", "ended"):
        change_tag(record(tmp_path / name), "paper", remove=False)
    change_tag(tmp_path / "ended", "old", remove=False)
    words = ["--connect", "tcp/127.0.0.1:1", "--json", "--run"]
    status_command([*words, f"{tmp_path}@paper"])
    assert [json.loads(line)["run"] for line in capsys.readouterr().out.splitlines()] == ["mine"]
    assert status_command([*words, f"{tmp_path}@old"]) == 1
    assert "no learner of a run with this tag answers; they are ended" in capsys.readouterr().err
    assert status_command([*words, f"{tmp_path}@none"]) == 1
    assert "has the tag 'none': the tags there are old, paper" in capsys.readouterr().err
