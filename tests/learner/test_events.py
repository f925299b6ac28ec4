"""Events of a run: counted, limited, reported, and kept in its directory."""

import json
import logging
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from daedalus.launch.logs import EVENTS
from daedalus.learner.serving import events
from daedalus.learner.serving.events import EventFile, EventLog, read_events
from daedalus.protocol.messages import Event


class Clock:
    now = 1000.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Clock that the test sets, of the wall and of the machine."""
    clock = Clock()

    def read() -> float:
        return clock.now

    fake = SimpleNamespace(monotonic=read, time=lambda: 1_800_000_000.25 + clock.now)
    monkeypatch.setattr(events, "time", fake)
    return clock


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the messages of events in this thread: threads of earlier tests may end, and say so, during this one."""
    here = threading.get_ident()
    return [record.getMessage() for record in caplog.records if (record.name, record.thread) == (EVENTS, here)]


def texts(log: EventLog) -> list[str]:
    return [event.text for event in log.report()]


def test_event_is_logged_and_reported_with_time_kind_and_actor(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    log = EventLog()
    log.add("refused", "refused: other spaces", actor="arm", level=logging.WARNING)
    (event,) = log.report()
    assert event.model_dump() == {
        "time": "2027-01-15T08:16:40.250Z",
        "kind": "refused",
        "actor": "arm",
        "text": "refused: other spaces",
        "count": 1,
    }
    (record,) = caplog.records
    assert (record.levelname, record.getMessage()) == ("WARNING", "refused: other spaces")
    assert (record.actor, record.event) == ("arm", "refused")  # type: ignore[attr-defined] - of this record


def test_the_filter_of_the_log_knows_the_logger() -> None:
    assert events._logger.name == EVENTS


def test_equal_events_of_a_minute_are_one_with_a_count(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    log = EventLog()
    for number in range(50):
        log.add("rejected", f"stale: lag {number}", actor="arm", cause="stale")
        log.add("rejected", "unfit", actor="arm", cause="unfit")
    assert [(event.text, event.count) for event in log.report()] == [("stale: lag 0", 50), ("unfit", 50)]
    assert lines(caplog) == ["stale: lag 0", "unfit"]
    clock.now += 61.0
    log.add("rejected", "stale: lag 99", actor="arm", cause="stale")
    assert texts(log) == ["stale: lag 0", "unfit", "stale: lag 99"]
    assert lines(caplog)[-1] == "stale: lag 99 (49 more times since the last message)"


def test_last_100_events_are_kept(clock: Clock) -> None:
    log = EventLog()
    for number in range(250):
        log.add("checkpoint", f"{number}")
    assert texts(log) == [f"{number}" for number in range(150, 250)]
    assert len(log._equal) == 100


def test_events_of_actors_are_rate_limited_and_those_of_the_run_are_not(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    log = EventLog()
    for number in range(1000):
        log.add("joined", "joined", actor=f"actor-{number}")
    log.add("checkpoint", "saved")
    assert len(lines(caplog)) == 102
    assert lines(caplog)[-2:] == ["900 events of actors were left out: too many at once", "saved"]
    clock.now += 3.0
    for number in range(10):
        log.add("left", "left", actor=f"actor-{number}")
    assert lines(caplog)[102:] == ["left"] * 3


def test_one_owner_does_not_push_out_the_events_of_others(clock: Clock) -> None:
    log = EventLog()
    log.add("joined", "joined", actor="honest")
    log.add("started", "started")
    for number in range(500):
        clock.now += 1.0
        log.add("joined", "joined", actor=f"evil.{number}")
    assert len(log.report()) == 100
    assert [event.actor for event in log.report()][:3] == ["honest", "", "evil.402"]


def test_long_texts_are_cut(clock: Clock) -> None:
    log = EventLog()
    log.add("refused", "x" * 5000, actor="a" * 5000)
    (event,) = log.report()
    assert (len(event.actor), len(event.text)) == (64, 300)


def test_causes_are_kept_bounded(clock: Clock) -> None:
    """A cause may be the text of a peer, and the newest of each is kept."""
    log = EventLog()
    log.add("refused", "refused", actor="arm", cause="x" * 250_000)
    assert max(len(text) for key in log._equal for text in key) == 300


def test_new_events_are_taken_once_and_the_counts_of_equal_ones_add_up(clock: Clock) -> None:
    log = EventLog()

    def taken() -> list[tuple[str, int]]:
        return [(event.text, event.count) for event in log.take_new()]

    for _ in range(3):
        log.add("rejected", "stale", actor="arm")
    log.add("started", "started")
    assert taken() == [("stale", 3), ("started", 1)]
    assert taken() == []
    for _ in range(2):
        log.add("rejected", "stale", actor="arm")
    assert taken() == [("stale", 2)]
    assert [event.count for event in log.report()] == [5, 1]


def event(text: str = "left", count: int = 1, time: str = "2026-11-22T10:15:00.250Z") -> Event:
    return Event(time=time, kind="left", actor="arm", text=text, count=count)


def test_events_of_several_processes_are_kept_in_order(tmp_path: Path) -> None:
    assert list(read_events(tmp_path)) == []
    learner, launcher = EventFile(tmp_path), EventFile(tmp_path)
    launcher.add_restart("the learner was killed by signal 9; started again")
    learner.add([event("first"), event("second", 7)])  # written later than the restart, and earlier in time
    EventFile(tmp_path).add([event("third", time="2999-11-22T10:15:00.250Z")])
    found = [(each.kind, each.actor, each.text, each.count) for each in read_events(tmp_path)]
    assert found == [
        ("left", "arm", "first", 1),
        ("left", "arm", "second", 7),
        ("restarted", "", "the learner was killed by signal 9; started again", 1),
        ("left", "arm", "third", 1),
    ]


def test_the_file_has_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "_MAX_BYTES", 1000)
    file = EventFile(tmp_path)
    for _ in range(100):
        file.add([event("x" * 300)])
    assert 0 < (tmp_path / "events.jsonl").stat().st_size <= 1000
    assert len(list(read_events(tmp_path))) == 2


def test_damaged_lines_are_left_out(tmp_path: Path) -> None:
    good = json.dumps({"time": 1, "kind": "left", "actor": "arm", "text": "y" * 5000, "count": 2})
    damaged = ["", "{", "[]", "7", "[" * 100_000, '{"time": ""}', good.replace("2}", "1e999}"), "\\xff", good[:-9]]
    (tmp_path / "events.jsonl").write_text("\n".join([*damaged, good]))
    (only,) = read_events(tmp_path)
    assert (only.time, only.text, only.count) == ("1", "y" * 300, 2)


def test_a_directory_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    EventFile(tmp_path / "gone").add([event()])
    EventFile(tmp_path / "gone").add_restart("started again")
    assert not (tmp_path / "gone").exists()
