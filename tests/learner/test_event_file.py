"""learner/serving/events.py: the events of a run, kept in its directory."""

import json
from pathlib import Path

import pytest

from daedalus.learner.serving import events
from daedalus.learner.serving.events import EventFile, read_events
from daedalus.protocol.messages import Event


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
