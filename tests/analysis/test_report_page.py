"""The page of `daedalus report` in a real browser: it loads nothing, runs nothing, and everybody can read it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import AXE, chromium, in_both_schemes
from league_statuses import LEAGUE
from recorded_runs import record
from test_report_command import GIF, HOSTILE, evaluated, happened

from daedalus.actor.environments.rendering import FrameRate
from daedalus.actor.evaluation.video import Video
from daedalus.cli.commands.report import report
from daedalus.protocol.league import RatedPlayer
from daedalus.protocol.texts import printable


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as one:
        yield one


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory, browser: Any) -> list[Path]:
    """Reports of a run with everything, of a run with little, and of several runs."""
    folder = tmp_path_factory.mktemp("reports")
    rich = evaluated(record(folder / "rich", rollouts_rejected={"stale": 3}), notes=[HOSTILE])
    happened(rich, ("started", "", "serving"), ("left", HOSTILE, HOSTILE), ("refused", "arm", "no such environment"))
    (rich / "output.log").write_text(f"{HOSTILE}\n" * 100)
    pytest.importorskip("av")
    with Video(rich / "replay.mp4") as video:
        for shade in range(20):
            video.add(np.full((64, 64, 3), 10 * shade, np.uint8), FrameRate())
    poor = record(folder / "poor", evaluation=None, finished=False)
    (poor / "replay.gif").write_bytes(GIF)
    record(folder / "other", settings=["collection.rollout_length=7"], returns=[None, None, 1.0])
    record(folder / "acrobot", preset="acrobot")
    players = (RatedPlayer(player=HOSTILE, rating=-1.0, deviation=1.0), *LEAGUE.players)
    game = record(folder / "game", league=LEAGUE.model_copy(update={"players": players, "left_out": 5}))
    total = {"games": 100, "wins": 38, "draws": 18, "losses": 44, "win_interval": [0.291, 0.478]}
    evaluated(game, matches={"opponent": "random", "total": total})
    assert report([str(rich)]) == report([str(poor)]) == report([str(game)]) == 0
    assert report([str(folder), "--output", str(folder / "report.html")]) == 0
    return [rich / "report.html", poor / "report.html", folder / "report.html", game / "report.html"]


@pytest.fixture
def opened(browser: Any) -> Iterator[Any]:
    """Function that opens a file without a network. No page may complain or load anything."""
    context = browser.new_context(offline=True)
    page = context.new_page()
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: complaints.append(dialog.message))
    page.on("request", lambda asked: complaints.append(asked.url) if asked.url.startswith(("http", "ws")) else None)

    def open_one(file: Path) -> Any:
        page.goto(file.as_uri())
        return page

    yield open_one
    context.close()
    assert complaints == []


@pytest.mark.parametrize("index", range(4))
def test_the_page_shows_what_it_has_without_network(reports: list[Path], opened: Any, index: int) -> None:
    page = opened(reports[index])
    assert page.locator("figure svg").count() >= 4
    text, colours = page.locator("figure svg text").first, set()
    for _ in in_both_schemes(page):
        colour = text.evaluate("each => getComputedStyle(each).fill")
        colours.add(colour)
        assert colour == text.evaluate("each => getComputedStyle(document.querySelector('footer')).color")
    assert len(colours) == 2
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.set_viewport_size({"width": 360, "height": 740})
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_the_video_plays(reports: list[Path], opened: Any) -> None:
    page = opened(reports[0])
    page.wait_for_function("document.querySelector('video').videoWidth === 64")
    assert page.locator("video").evaluate("video => video.duration") == pytest.approx(20 / 30, abs=0.1)
    page = opened(reports[1])
    assert page.locator("img").evaluate("picture => picture.naturalWidth") == 1


def test_a_game_with_opponents_has_ratings_and_a_matrix(reports: list[Path], opened: Any) -> None:
    page = opened(reports[3])
    assert page.locator("h2").first.inner_text() == "League"
    rows = page.get_by_role("region", name="players by rating").locator("tbody tr").all_inner_texts()
    assert rows[0].split("\t") == ["newest", "1,312 ± 50", "1,200", "-"]
    assert rows[-1].split("\t") == [printable(HOSTILE), "-1 ± 1", "0", "-"]
    assert page.locator("text=5 more players are not shown").count() == 1
    cell = page.locator(".matrix tr:has(th:text-is('v0')) td span").nth(1)
    assert (cell.inner_text(), cell.get_attribute("class")) == ("75", "wins")
    assert cell.get_attribute("title") == "v0 against newest: 75% of 40 matches (30 won, 0 drawn, 10 lost)"
    assert page.locator("figcaption", has_text="win rate against random").count() == 1
    row = page.locator("tr", has=page.locator("th:text-is('games won against random')"))
    assert row.locator("td").inner_text() == "38 of 100, drawn 18, lost 44"


@pytest.mark.parametrize("index", range(4))
def test_axe_finds_nothing(reports: list[Path], opened: Any, index: int) -> None:
    if not AXE.exists():
        pytest.skip("axe-core is not installed: run `make examples`")
    page = opened(reports[index])
    page.evaluate("document.querySelectorAll('details').forEach(each => each.open = true)")
    page.evaluate(AXE.read_text("utf-8"))
    for scheme in in_both_schemes(page):
        found = page.evaluate("async () => (await axe.run()).violations")
        assert [f"{each['id']}: {node['html'][:150]}" for each in found for node in each["nodes"]] == [], scheme
