"""gateway/watching/monitor.py: what is observed of a learner that comes, restarts, does not answer, and ends."""

from collections.abc import Iterator

import pytest
from processes import LIMIT, until
from statuses import actor_status, run_status
from watched import FakeSource

from daedalus.gateway.watching import monitor as monitor_module
from daedalus.gateway.watching.monitor import RunMonitor
from daedalus.gateway.watching.page_data import FolderView, Observation
from daedalus.protocol.messages import Event


class Watched:
    """A monitor, and its observations."""

    def __init__(self) -> None:
        self.source, self.seen, self.end = FakeSource(), list[Observation](), ""
        self.folder: FolderView | None = None
        self.monitor = RunMonitor(self.source, self.seen.append, lambda: self.end, lambda run: self.folder)

    def until_state(self, state: str) -> Observation:
        until(lambda: self.seen and self.seen[-1].state == state)
        return self.seen[-1]


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[Watched]:
    monkeypatch.setattr(monitor_module, "WATCHED_SECONDS", 0.01)
    one = Watched()
    one.monitor.watch(True)
    one.monitor.open()
    yield one
    one.monitor.close()


def test_a_run_comes_is_lost_returns_and_ends(watched: Watched) -> None:
    watched.until_state("waiting")
    watched.source.answer = run_status((actor_status("a"),))
    assert [actor.actor for actor in watched.until_state("running").actors] == ["a"]
    watched.source.fails = True
    lost = watched.until_state("lost")
    assert (lost.reason, lost.status, len(lost.actors)) == ("the router is gone", watched.source.answer, 1)
    watched.source.fails = False
    watched.until_state("running")
    watched.end = "the run is over: solved"
    watched.source.answer = None
    ended = watched.until_state("ended")
    assert ended.reason == "the run is over: solved"
    assert ended.status is not None  # the result
    watched.end, watched.source.answer = "", run_status(learner_epoch=2)
    watched.until_state("running")


def test_a_run_whose_learner_has_ended_is_stopped_by_its_directory(watched: Watched) -> None:
    watched.source.answer = run_status()
    watched.until_state("running")
    watched.source.answer = None
    watched.until_state("lost")
    watched.folder = FolderView(settings=(), output="", ends=("Continue it with: daedalus resume r",), stopped=True)
    assert watched.until_state("stopped").folder == watched.folder
    watched.source.answer = run_status()
    watched.until_state("running")
    watched.monitor.close()
    watched.folder = FolderView(settings=(), output="", ends=("Report: r/report.html",))
    assert watched.monitor.last_look().state == "ended"  # what the learner could not say any more


def test_all_pages_of_the_metrics_are_read_and_then_only_new_rows(watched: Watched) -> None:
    watched.source.rows = [{"env_steps": float(step)} for step in range(8)]
    watched.source.answer = run_status()
    until(lambda: watched.seen and len(watched.seen[-1].rows) == 8)
    first = watched.seen[-1]
    watched.source.rows.append({"env_steps": 8.0, "entropy": 0.5})
    until(lambda: len(watched.seen[-1].rows) == 9)
    assert watched.seen[-1].rows[:8] == first.rows
    assert watched.seen[-1].rows[8] == (8, {"env_steps": 8.0, "entropy": 0.5})
    assert watched.seen[-1].generation == first.generation


def test_another_learner_epoch_begins_the_rows_anew(watched: Watched) -> None:
    watched.source.rows, watched.source.answer = [{"env_steps": 1.0}, {"env_steps": 2.0}], run_status()
    until(lambda: watched.seen and len(watched.seen[-1].rows) == 2)
    before = watched.seen[-1].generation
    watched.source.rows = [{"env_steps": 5.0}]
    watched.source.answer = run_status(learner_epoch=2)
    until(lambda: watched.seen[-1].generation > before and len(watched.seen[-1].rows) == 1)
    assert watched.seen[-1].rows[0][1] == {"env_steps": 5.0}


def test_rows_are_bounded(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(monitor_module, "_MAX_ROWS", 4)
    watched.source.answer = run_status()
    for step in range(30):  # the learner keeps its newest rows
        watched.source.oldest = step - 3
        watched.source.rows = [{"env_steps": float(number)} for number in range(step + 1)]
        until(lambda step=step: watched.seen and watched.seen[-1].rows and watched.seen[-1].rows[-1][0] == step)
    assert max(len(seen.rows) for seen in watched.seen) <= 8


def test_equal_parts_stay_the_same_objects(watched: Watched) -> None:
    event = Event(time="2026-11-22T13:16:45.123Z", kind="joined", actor="a", text="joined", count=1)
    watched.source.newest_events = (event,)
    watched.source.answer = run_status((actor_status("a"),))
    until(lambda: len(watched.seen) > 5 and watched.seen[-5].state == "running")
    one, other = watched.seen[-3], watched.seen[-1]
    assert one.actors is other.actors
    assert one.events is other.events
    assert one.rows is other.rows


def test_a_large_fleet_is_not_queried_each_time(watched: Watched) -> None:
    actors = tuple(actor_status(f"a{number:03}") for number in range(100))
    watched.source.answer = run_status(actors, actors_alive=1000)
    until(lambda: 0 in watched.source.asked_actors)
    assert any(asked > 1000 for asked in watched.source.asked_actors)


def test_nobody_watching_means_few_queries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(monitor_module, "UNWATCHED_SECONDS", 3600.0)
    monkeypatch.setattr(monitor_module, "WATCHED_SECONDS", 0.01)
    one = Watched()
    one.monitor.open()
    try:
        assert one.source.asked.acquire(timeout=LIMIT)
        assert not one.source.asked.acquire(timeout=0.3)
        one.monitor.watch(True)  # the first viewer does not wait
        until(lambda: len(one.seen) > 1)
    finally:
        one.monitor.close()
