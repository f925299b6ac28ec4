"""The page in a real browser: of a real run, and of runs that no test can wait for."""

import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from browser import AXE, Visit, chromium, in_both_schemes
from certificates import make_certificates
from gateways import RunningGateway
from league_statuses import LEAGUE
from processes import ENDLESS, LIMIT, Running, processes_mentioning, starting, until
from scripted_learner import SPEC, ScriptedLearner, acknowledge
from statuses import actor_status, run_status
from watched import HOSTILE, observed

from daedalus.gateway.places import Places
from daedalus.gateway.security import OperatorToken
from daedalus.gateway.watching.page_data import FolderView
from daedalus.learner.reporting.metrics_rows import league_columns
from daedalus.protocol.league import RatedPlayer
from daedalus.protocol.messages import Event, Order
from daedalus.transport.connecting import connect
from daedalus.transport.memory import MemoryNetwork
from daedalus.transport.status_query import ask

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Debian's chromium")
MILLISECONDS = 1000 * LIMIT
FOLDER = FolderView(
    settings=(("environment.id", HOSTILE, True), ("training.discount_factor", "0.99", False)), output=HOSTILE
)
TOKEN = "an operator's token of some length"
Open = Callable[..., Visit]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as one:
        yield one


@pytest.fixture
def visit(browser: Any) -> Iterator[Open]:
    """Function that opens a page; at the end no page may have complained, or asked another host."""
    visits: list[Visit] = []

    def visit_one(address: str, **options: Any) -> Visit:
        visits.append(Visit(browser, address, **options))
        return visits[-1]

    yield visit_one
    for one in visits:
        one.close()
    for one in visits:
        assert one.complaints == []
        assert one.strange_requests == []


@pytest.fixture
def gateway(network: MemoryNetwork) -> Iterator[RunningGateway]:
    running = RunningGateway(network, follows=False)
    yield running
    running.close()


def show(gateway: RunningGateway, *arguments: Any, **fields: Any) -> None:
    gateway.call(lambda: gateway.data.show(observed(*arguments, **fields)))


def enter(page: Any, token: str) -> Any:
    """Give the page the token that it asks for, and return the page."""
    page.locator("#token").fill(token)
    page.get_by_role("button", name="Open").click()
    return page


def wait_for(page: Any, expression: str) -> None:
    """Wait until an expression of JavaScript is true. The page forbids what Playwright's own wait does."""
    until(lambda: page.evaluate(expression))


def text_of(page: Any, selector: str) -> str:
    return page.locator(selector).inner_text()


# ------------------------------------------------------------------------------------------------- a real run


class Run:
    """`daedalus train --watch`."""

    def __init__(self, process: Running) -> None:
        self.process = process
        self.learner = process.expect(r" at (unixsock-stream/\S+);")[1]
        found = process.expect(r"watch the run at (http\S+) with the token in run/operator-token$")
        self.address = found[1]
        self.token = (Path(os.readlink(f"/proc/{process.process.pid}/cwd")) / "run/operator-token").read_text().strip()

    @contextmanager
    def still(self) -> Iterator[None]:
        """Stop the run's own actor for a while: its endless steps would take a processor."""
        actors = {*processes_mentioning(self.learner)} & {*processes_mentioning("actor-0")}
        for pid in actors:
            os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            for pid in actors:
                os.kill(pid, signal.SIGCONT)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, browser: Any) -> Iterator[tuple[Run, Callable[..., Running]]]:
    """A run, and a function that starts further commands. Asking for the browser first skips without one."""
    with starting(tmp_path_factory.mktemp("watched")) as start:
        process = start("train", "cartpole", "--watch", "--clients", "--run-dir", "run", "--actors", 1, *ENDLESS)
        yield Run(process), start


def test_curves_appear_and_a_killed_actor_shows_as_gone(run: tuple[Run, Callable[..., Running]], visit: Open) -> None:
    watched, start = run
    page = enter(visit(watched.address).page, watched.token)
    page.wait_for_selector("#charts .line", timeout=MILLISECONDS)
    wait_for(page, "document.querySelectorAll('#charts .line').length >= 5")
    wait_for(page, "document.querySelector('#state').textContent === 'running'")
    assert text_of(page, "#run") == "run"
    with watched.still():
        actor = start("actor", "--connect", watched.learner, "--name", "fragile")
        row = "tr:has(td:text-is('fragile'))"
        page.wait_for_selector(f"{row}[data-state='alive']", timeout=MILLISECONDS)
        actor.process.send_signal(signal.SIGKILL)
        page.wait_for_selector(f"{row}[data-state='gone']", timeout=MILLISECONDS)
        page.wait_for_selector("#log li:has-text('fragile'):has-text('left')", timeout=MILLISECONDS)


def test_a_page_that_is_opened_late_shows_the_run_from_its_begin(
    run: tuple[Run, Callable[..., Running]], visit: Open
) -> None:
    with run[0].still():
        page = enter(visit(run[0].address).page, run[0].token)
        wait_for(page, "document.querySelector('#charts .line')?.getAttribute('d').includes('L')")
    label = page.locator("#charts svg").first.get_attribute("aria-label")
    assert "from" in label


def test_three_pages_that_play_are_three_actors_that_the_run_learns_from(
    run: tuple[Run, Callable[..., Running]], visit: Open
) -> None:
    pages = [visit(f"{run[0].address}play").page for _ in range(3)]
    for page in pages:
        page.locator("#fast").check()
    names = {page.locator("#name").input_value() for page in pages}
    assert len(names) == 3
    with run[0].still(), closing(connect([run[0].learner])) as transport:
        until(lambda: names <= {one.actor for status in ask(transport) for one in status.actors if one.env_steps > 0})
        played = [one for one in ask(transport)[0].actors if one.actor in names]
        assert not {cause for one in played for cause in one.rollouts_rejected} - {"stale"}
    assert all("Playing as" in text_of(page, "#status") for page in pages)


def test_an_episode_is_shown_on_request(run: tuple[Run, Callable[..., Running]], visit: Open) -> None:
    page = enter(visit(run[0].address).page, run[0].token)
    with run[0].still():
        page.locator("#camera-switch:enabled").click()
        page.wait_for_selector("#camera-view .bars li:nth-child(2)", timeout=MILLISECONDS)
    assert page.locator("#camera-view canvas").evaluate("canvas => canvas.width") > 300
    page.locator("#camera-switch").click()
    assert page.locator("#camera-view").is_hidden()


def test_an_operator_stops_the_run_and_the_page_shows_its_end(
    run: tuple[Run, Callable[..., Running]], visit: Open
) -> None:
    process, visited = run[0].process, visit(run[0].address)
    page, visited.loses_gateway = visited.page, True
    enter(page, run[0].token)
    wait_for(page, "document.querySelector('#operator-token').value !== ''")
    assert page.locator("#operator-token").input_value() == run[0].token
    page.locator("#operator-token").fill("wrong")
    page.get_by_role("button", name="Save a checkpoint").click()
    wait_for(page, "document.querySelector('#order-result').textContent.startsWith('Not done')")
    page.locator("#operator-token").fill(run[0].token)
    page.get_by_role("button", name="Stop the run").click()
    page.get_by_role("dialog").get_by_role("button", name="Keep running").click()
    assert process.process.poll() is None
    page.get_by_role("button", name="Stop the run").click()
    page.get_by_role("dialog").get_by_role("button", name="Stop the run").click()
    assert process.wait() == 1, process.output
    assert "; continue with: daedalus resume run" in process.output
    page.wait_for_selector("#notices:has-text('The gateway has ended, too')")
    assert page.locator("#state").get_attribute("data-state") == "stopped"
    assert "Continue it with: daedalus resume run" in text_of(page, "#notices")


def test_a_person_plays_tic_tac_toe_against_the_newest_policy(tmp_path: Path, browser: Any, visit: Open) -> None:
    game = ("--env", "pettingzoo.classic.tictactoe_v3", "--env-steps", 10**9)
    with starting(tmp_path) as start:
        watched = Run(start("train", *game, "--watch", "--run-dir", "run", "--actors", 1))
        visited = visit(watched.address)
        page, visited.loses_gateway = enter(visited.page, watched.token), True
        page.get_by_role("link", name="Play against the policy").click()
        enter(page, watched.token)
        page.get_by_role("button", name="Begin a match").click()
        wait_for(page, "/Your turn/.test(document.querySelector('#status').textContent)")
        with watched.still():
            play_twice(page, visited)
        assert watched.process.process.poll() is None


def play_twice(page: Any, visited: Visit) -> None:
    """Play a match as each player, and check what the page says of it."""
    for agent in ("player_1", "player_2"):
        wait_for(page, f"/Your turn, {agent}/.test(document.querySelector('#status').textContent)")
        assert page.locator("#board button").count() == 9
        played = 0
        while page.locator("#board [aria-disabled=false]").count():
            cell = page.locator("#board [aria-disabled=false]").first
            if played:
                cell.click()
            else:  # by the keyboard alone
                cell.focus()
                page.keyboard.press("Enter")
            played += 1
            mine = f"document.querySelectorAll('[data-mark=you]').length === {played}"
            wait_for(page, mine)
            assert page.locator("#board [aria-label*=', you']").count() == played
        counts = [page.locator(f"[data-mark={owner}]").count() for owner in ("you", "policy")]
        assert counts[0] - counts[1] in ((0, 1) if agent == "player_1" else (0, -1))
        outcome = re.search("(You won|You lost|A draw): your return is (-?1|0), that of", text_of(page, "#status"))
        assert outcome, text_of(page, "#status")
        assert {"1": "You won", "-1": "You lost", "0": "A draw"}[outcome[2]] == outcome[1]
        if AXE.exists():
            assert visited.violations() == []
        page.locator("#agent").select_option("player_2")
        page.get_by_role("button", name="Play again").click()


# --------------------------------------------------------------------------------------- runs made for the page


def test_texts_of_peers_are_shown_as_texts(gateway: RunningGateway, visit: Open) -> None:
    actor = actor_status(HOSTILE, host=HOSTILE, quarantined=HOSTILE, rollouts_rejected={HOSTILE: 2})
    event = Event(time="2026-11-22T13:16:45.123Z", kind="joined", actor=HOSTILE, text=HOSTILE, count=2)
    status = run_status((actor,), run=HOSTILE, environment=HOSTILE, algorithm=HOSTILE, problems=(HOSTILE,))
    show(gateway, status, [{"env_steps": 1.0, f"user/{HOSTILE}": 2.0}], events=(event,), reason=HOSTILE)
    page = visit(f"http://127.0.0.1:{gateway.port}/").page
    page.wait_for_selector("#actors tbody tr")
    assert page.locator("img").count() == 0
    for selector in ("#run", "#actors", "#log", "#notices"):
        page.locator(selector, has_text=HOSTILE).wait_for()  # events may come after the status
    assert page.title().startswith(HOSTILE)


def test_a_page_before_the_learner_and_after_the_end_says_so(gateway: RunningGateway, visit: Open) -> None:
    page = visit(f"http://127.0.0.1:{gateway.port}/").page
    page.wait_for_selector("#notices:has-text('has not reached its network yet')")
    gateway.call(lambda: gateway.data.show(gateway.data.seen.__class__(state="waiting")))
    page.wait_for_selector("#notices:has-text('No learner has answered yet')")
    folder = replace(FOLDER, ends=("Report: runs/r/report.html",))
    status = run_status(episode_return_mean=12.5)
    show(gateway, status, state="ended", reason="the run is over: the learner has finished", folder=folder)
    page.wait_for_selector("#notices:has-text('The run has ended: the run is over')")
    assert "return 12.5 after 100 env_steps" in text_of(page, "#notices")
    assert "Report: runs/r/report.html" in text_of(page, "#notices")


def test_the_camera_is_second_and_settings_that_differ_are_first(
    network: MemoryNetwork, gateway: RunningGateway, visit: Open, tmp_path: Path
) -> None:
    (tmp_path / "token").write_text(TOKEN)
    with closing(RunningGateway(network, follows=False, operator=OperatorToken(tmp_path / "token"))) as guarded:
        show(guarded, run_status(), folder=FOLDER)
        visited = visit(f"http://127.0.0.1:{guarded.port}/")
        page, visited.loses_gateway = enter(visited.page, TOKEN), True
        page.wait_for_selector("#changed tr")
        order = page.evaluate("[...document.querySelectorAll('main > section')].map((each) => each.id)")
        assert order[:5] == ["summary", "learning", "league", "camera", "metrics"]
        assert page.locator("#league").is_hidden()  # of games only
        for selector in ("#changed", "#output"):
            page.locator(selector, has_text=HOSTILE).wait_for()
        assert page.locator("img").count() == 0
        assert page.locator("#unchanged td").is_hidden()
        page.locator("#unchanged-title").click()
        assert text_of(page, "#unchanged td") == "0.99"
        page.close()
    show(gateway, run_status(), folder=FOLDER)
    page = visit(f"http://127.0.0.1:{gateway.port}/").page
    page.wait_for_selector("#output-note:has-text('holders of a token')")
    assert HOSTILE not in text_of(page, "main")


def test_curves_are_smoothed_zoomed_added_and_removed(gateway: RunningGateway, visit: Open) -> None:
    rows = [
        {"env_steps": 10.0 * step, "episode_return_mean": float(step % 2), "a": 1.0, "b": 2.0} for step in range(101)
    ]
    show(gateway, run_status(), rows)
    page = visit(f"http://127.0.0.1:{gateway.port}/").page
    page.wait_for_selector("#return .line")
    label = page.locator("#return svg")
    assert label.get_attribute("aria-label") == "Return: 0 at the end, from 0 to 1,000"
    page.locator("#smoothing").select_option("20 rows")
    assert label.get_attribute("aria-label") == "Return: 0.5 at the end, from 0 to 1,000"
    page.locator("#part").select_option("last half")
    assert label.get_attribute("aria-label") == "Return: 0.5 at the end, from 500 to 1,000"
    page.locator("#part").select_option("whole run")
    box = label.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 50)
    page.mouse.up()
    assert page.locator("#part").input_value() == "as chosen"
    first, last = map(int, re.findall(r"from (\d+) to (\d+)", label.get_attribute("aria-label"))[0])
    assert 400 < first < 550 < last < 800
    for name in ("a", "b"):
        page.locator("#further").select_option(name)
    assert page.locator("#charts h3").all_inner_texts()[-2:] == ["a", "b"]
    page.get_by_role("button", name="Remove a").click()
    assert page.locator("#charts h3").all_inner_texts()[-1] == "b"
    assert page.locator("#further option").all_inner_texts() == ["choose", "a", "env_steps"]


def test_a_game_with_opponents_shows_ratings_and_who_beats_whom(gateway: RunningGateway, visit: Open) -> None:
    players = (RatedPlayer(player=HOSTILE, rating=1.0, deviation=0.5), *LEAGUE.players)
    league = LEAGUE.model_copy(update={"players": players, "left_out": 3})
    rows = [{"env_steps": 10.0 * step, **league_columns(LEAGUE)} for step in range(3)]
    show(gateway, run_status(league=league), rows)
    page = visit(f"http://127.0.0.1:{gateway.port}/").page
    page.wait_for_selector("#matrix tbody tr")
    page.wait_for_selector("#rating .line", state="attached")  # rows may come after the status
    assert page.locator("#rating svg").get_attribute("aria-label") == "Rating: 1,313 at the end, from 0 to 20"
    assert page.locator("#win-rates h3").all_inner_texts() == [
        "Win rate against my_bots.Greedy",
        "Win rate against random",
    ]
    assert text_of(page, "#tiles .tile:first-child").split("\n") == ["Rating", "1,313", "± 50, of the newest policy"]
    best = page.locator("#players tbody tr").first
    assert best.locator("td").all_inner_texts() == ["newest", "1,313 ± 50", "", "1,200", "-"]
    assert text_of(page, "#players tr:has(td:text-is('random')) td:last-child") == "97 %"
    assert "3 players more are kept" in text_of(page, "#league-note")
    cell = page.locator("#matrix tr:has(th:text-is('v0')) td").nth(1)  # hostile, newest, v0, ...
    assert (cell.inner_text(), cell.get_attribute("class")) == ("75", "number wins")
    assert cell.get_attribute("title") == "v0 against newest: 75 % of 40 matches (30 won, 0 drawn, 10 lost)"
    colours = page.locator("#matrix td.number").evaluate_all(
        "cells => cells.map((each) => getComputedStyle(each).backgroundColor)"
    )
    assert len(set(colours)) > 5
    assert HOSTILE in text_of(page, "#players")
    assert page.locator("img").count() == 0
    show(gateway, run_status(), rows)
    page.wait_for_selector("#league", state="hidden")


def test_an_order_that_the_gateway_does_not_receive_or_answer_is_reported(
    network: MemoryNetwork, visit: Open, tmp_path: Path
) -> None:
    (tmp_path / "token").write_text(TOKEN)
    gateway = RunningGateway(network, follows=False, operator=OperatorToken(tmp_path / "token"))
    asked, answer = threading.Event(), threading.Event()

    def give_order(order: Order, token: str) -> tuple[bool, str]:
        asked.set()
        answer.wait(LIMIT)
        return True, ""

    gateway.data.give_order = give_order
    try:
        visited = visit(f"http://127.0.0.1:{gateway.port}/")
        page, visited.loses_gateway = visited.page, True
        show(gateway, run_status())
        enter(page, TOKEN)
        page.get_by_role("button", name="Save a checkpoint").click()
        page.wait_for_selector("#order-result:has-text('Asking the learner')")
        assert asked.wait(LIMIT)
    finally:
        closing = threading.Thread(target=gateway.close)
        closing.start()
        answer.set()
        closing.join(LIMIT)
    wait_for(page, "!document.querySelector('#order-result').textContent.startsWith('Asking')")
    wait_for(page, "document.querySelector('#state').dataset.state === 'closed'")
    page.get_by_role("button", name="Save a checkpoint").click()
    page.wait_for_selector("#order-result:has-text('Not done: the gateway does not answer')")


def test_a_page_that_is_not_served_says_why(gateway: RunningGateway, visit: Open) -> None:
    gateway.call(lambda: setattr(gateway.data, "places", Places(0, "pages")))
    page = visit(f"http://127.0.0.1:{gateway.port}/").page
    page.wait_for_selector("#notices:has-text('0 pages are connected already: try again later')")


def test_play_takes_no_part_in_a_run_of_another_environment(network: MemoryNetwork, visit: Open) -> None:
    other = SPEC.model_copy(update={"environment": SPEC.environment.model_copy(update={"id": "Other-v0"})})
    learner = ScriptedLearner(network, other)
    learner.publish(0)
    running = RunningGateway(network)
    try:
        page = visit(f"http://127.0.0.1:{running.port}/play").page
        page.wait_for_selector("#status:has-text('Not playing: the run plays Other-v0')", timeout=MILLISECONDS)
        assert "daedalus train cartpole --watch --clients" in text_of(page, "#elsewhere")
        assert text_of(page, "#steps") == "0"
    finally:
        running.close()
        learner.transport.close()


def test_play_beyond_loopback_needs_the_token_of_its_name(
    network: MemoryNetwork, learner: ScriptedLearner, visit: Open, tmp_path: Path
) -> None:
    folder = make_certificates(tmp_path / "certs", "gateway", "client phone")
    with closing(RunningGateway(network, folder / "gateway")) as running:
        # The test does not install the CA in the browser, as the visitor of a phone would.
        page = visit(f"https://127.0.0.1:{running.port}/play", ignore_https_errors=True).page
        page.wait_for_selector("#status:has-text('Not playing: the token is not one of this name')")
        page.locator("#name").fill("phone")
        page.locator("#token").fill((folder / "client-phone" / "token").read_text().strip())
        page.get_by_role("button", name="Play").click()
        page.wait_for_selector("#status:has-text('Playing as phone')", timeout=MILLISECONDS)
        rollout, request = learner.receive()
        acknowledge(request, "accepted")
        assert rollout.identity.actor == "phone"
        assert rollout.rewards.tolist() == [[1.0]] * len(rollout.rewards)
        page.close()  # it would try to connect to a gateway that is closed, which its console reports


def test_a_thousand_actors_are_aggregated_filtered_and_sorted_by_keyboard(gateway: RunningGateway, visit: Open) -> None:
    actors = tuple(
        actor_status(
            f"wing-{number}", host=f"host-{number % 7}", env_steps_per_second=float(number), alive=number != 500
        )
        for number in range(1000)
    )
    show(gateway, run_status(actors))
    page = visit(f"http://127.0.0.1:{gateway.port}/").page
    page.wait_for_selector("#hosts tbody tr:nth-child(7)")
    assert text_of(page, "#totals").startswith("1,000 actors: 999 alive")
    assert page.locator("#actors tbody tr").count() == 100
    header = page.get_by_role("columnheader", name="env_steps/s").last.get_by_role("button")
    header.focus()
    page.keyboard.press("Enter")
    assert page.locator("#actors tbody tr td").first.inner_text() == "wing-999"
    page.keyboard.press("Enter")
    assert page.locator("#actors tbody tr td").first.inner_text() == "wing-0"
    assert page.locator("#actors th[aria-sort='ascending']").inner_text().startswith("env_steps/s")
    show(gateway, run_status((actor_status("arm", epsilon=0.1, missed_deadlines=3, safe_reason="too old"), *actors)))
    page.wait_for_selector("#actors th:has-text('Safe reason')")
    titles = page.locator("#actors th").all_inner_texts()
    assert titles[-3:] == ["Exploration", "Missed deadlines", "Safe reason"]
    page.locator("#filter").fill("gone host-3")
    assert text_of(page, "#totals").startswith("1 actor of 1,001 actors: 0 alive")
    assert page.locator("#actors tbody tr td").first.inner_text() == "wing-500"


@pytest.mark.parametrize("width", [390, 1280])
def test_page_is_accessible_and_fits(gateway: RunningGateway, visit: Open, width: int) -> None:
    quarantined = actor_status("wing-2", quarantined="its rollouts are not finite")
    actors = (actor_status("wing-1", compact_snapshots=True), quarantined, actor_status("wing-3", alive=False))
    rows = [{"env_steps": 100.0 * step, "episode_return_mean": 1.0 * step, "entropy": 0.5} for step in range(20)]
    rows = [{**row, **league_columns(LEAGUE)} for row in rows]
    event = Event(time="2026-11-22T13:16:45.123Z", kind="left", actor="wing-3", text="no longer connected", count=1)
    status = run_status(actors, problems=("no update for 61 s",), league=LEAGUE)
    show(gateway, status, rows, events=(event,), folder=FOLDER)
    for path, selector in (("", "#return .line"), ("play", "#status"), ("match", "#status")):
        one = visit(f"http://127.0.0.1:{gateway.port}/{path}", viewport={"width": width, "height": 800})
        one.page.wait_for_selector(selector)
        for _ in in_both_schemes(one.page):
            overflow = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
            assert one.page.evaluate(overflow) <= 0
            assert one.violations() == []
