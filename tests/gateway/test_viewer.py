"""The page's WebSocket and files: what a viewer receives, who may watch and give orders, and bad input."""

import asyncio
import json
import re
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, nullcontext
from email.message import Message
from pathlib import Path
from typing import Any

import pytest
from certificates import change_certificates, make_certificates
from gateways import RunningGateway
from processes import LIMIT, until
from scripted_learner import ScriptedLearner
from statuses import actor_status, run_status
from watched import FakeSource, observed
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from daedalus.gateway.client_messages import ClientError
from daedalus.gateway.places import Places
from daedalus.gateway.security import TOKENS, OperatorToken, Tokens, digest
from daedalus.gateway.watching.page_data import FolderView, OtherRun
from daedalus.transport.memory import MemoryNetwork

TOKEN = "an operator's token of some length"


class Viewer:
    """A page, spoken by hand."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket

    def send(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def receive(self, *kinds: str) -> dict[str, Any]:
        """Return the next message of one of the kinds."""
        while True:
            data = self.socket.recv(timeout=LIMIT)
            assert isinstance(data, str)
            message = json.loads(data)
            if message["type"] in kinds:
                return message

    def closed(self) -> int:
        with pytest.raises(ConnectionClosed) as closed:
            self.receive("nothing")
        assert closed.value.rcvd is not None
        return closed.value.rcvd.code


Watch = Callable[..., Viewer]


@pytest.fixture
def gateway(network: MemoryNetwork, tmp_path: Path) -> Iterator[RunningGateway]:
    """A gateway that takes orders, and whose page data the test sets."""
    (tmp_path / "token").write_text(TOKEN + "\n")
    running = RunningGateway(network, follows=False, operator=OperatorToken(tmp_path / "token"))
    yield running
    running.close()
    assert running.failure is None


@pytest.fixture
def watch(gateway: RunningGateway) -> Iterator[Watch]:
    with ExitStack() as stack:

        def open_one(token: str = TOKEN, **options: Any) -> Viewer:
            socket = connect(f"ws://127.0.0.1:{gateway.port}/watch", open_timeout=LIMIT, max_size=None, **options)
            viewer = Viewer(stack.enter_context(socket))
            viewer.send(type="hello", token=token)
            return viewer

        yield open_one


def show(gateway: RunningGateway, *arguments: Any, **fields: Any) -> None:
    gateway.call(lambda: gateway.data.show(observed(*arguments, **fields)))


def fetch(gateway: RunningGateway, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    request = urllib.request.Request(f"http://127.0.0.1:{gateway.port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=LIMIT) as answer:
            return answer.status, _lowered(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, _lowered(error.headers), error.read()


def _lowered(headers: Message) -> dict[str, str]:
    return {name.lower(): value for name, value in headers.items()}


def test_a_page_that_is_opened_before_there_is_a_learner_says_so(watch: Watch) -> None:
    viewer = watch()
    assert viewer.receive("hello") == {
        "type": "hello",
        "orders": True,
        "camera": False,
        "clients": True,
        "matches": False,
    }
    assert viewer.receive("run") == {"type": "run", "state": "connecting", "reason": "", "ends": [], "status": None}
    # A page that was connected before may still show the actors and curves of another run.
    assert viewer.receive("actors")["rows"] == []
    assert viewer.receive("events")["events"] == []
    assert viewer.receive("metrics") == {"type": "metrics", "reset": True, "columns": [], "rows": []}


def test_a_page_that_is_opened_late_receives_the_whole_run(gateway: RunningGateway, watch: Watch) -> None:
    rows = [{"env_steps": float(step), **({"entropy": 0.5} if step else {})} for step in range(3)]
    show(gateway, run_status((actor_status("a", rollouts_rejected={"stale": 2}),)), rows)
    viewer = watch()
    run = viewer.receive("run")
    assert (run["state"], run["status"]["run"], "actors" in run["status"]) == ("running", "mine", False)
    actors = viewer.receive("actors")
    actor = dict(zip(actors["columns"], actors["rows"][0], strict=True))
    assert (actor["actor"], actor["rollouts_rejected"]) == ("a", {"stale": 2})
    metrics = viewer.receive("metrics")
    assert metrics["reset"]
    assert metrics["columns"] == ["env_steps", "entropy"]
    assert metrics["rows"] == [[0.0, None], [1.0, 0.5], [2.0, 0.5]]


def test_later_messages_have_what_has_changed(gateway: RunningGateway, watch: Watch) -> None:
    rows = [{"env_steps": 1.0}, {"env_steps": 2.0}]
    first = observed(run_status((actor_status("a"),)), rows)
    gateway.call(lambda: gateway.data.show(first))
    viewer = watch()
    viewer.receive("metrics")
    second = observed(run_status(env_steps=200), [*rows, {"env_steps": 3.0}], actors=first.actors)
    gateway.call(lambda: gateway.data.show(second))
    assert viewer.receive("run", "actors")["status"]["env_steps"] == 200
    assert viewer.receive("actors", "metrics") == {
        "type": "metrics",
        "reset": False,
        "columns": ["env_steps"],
        "rows": [[3.0]],
    }
    show(gateway, run_status(), [{"env_steps": 1.0}], generation=1)
    assert viewer.receive("metrics")["reset"]


def test_only_the_holder_of_a_token_reads_the_run_directory(
    network: MemoryNetwork, gateway: RunningGateway, watch: Watch
) -> None:
    folder = FolderView(settings=(("a.b", "1", True),), output="[actor-0] hello")
    show(gateway, run_status(), folder=folder)
    received = watch().receive("folder")
    assert (received["settings"], received["output"]) == ([["a.b", "1", True]], "[actor-0] hello")
    with closing(RunningGateway(network, follows=False)) as openly:
        show(openly, run_status(), folder=folder)
        with connect(f"ws://127.0.0.1:{openly.port}/watch", open_timeout=LIMIT) as socket:
            viewer = Viewer(socket)
            viewer.send(type="hello", token="")
            assert viewer.receive("folder") == {"type": "folder", "settings": None, "output": None}


def test_an_open_page_receives_the_last_state_before_the_gateway_ends(gateway: RunningGateway, watch: Watch) -> None:
    show(gateway, run_status())
    viewer = watch()
    viewer.receive("metrics")
    folder = FolderView(settings=(), output="", ends=("Report: r/report.html",))
    last = observed(run_status(), state="ended", folder=folder)
    asyncio.run_coroutine_threadsafe(gateway.data.close(last), gateway.loop).result(LIMIT)
    message = viewer.receive("run")
    assert (message["state"], message["ends"]) == ("ended", ["Report: r/report.html"])


def test_numbers_that_json_does_not_have_are_null(gateway: RunningGateway, watch: Watch) -> None:
    show(gateway, run_status(), [{"env_steps": 1.0, "entropy": float("inf")}])
    assert watch().receive("metrics")["rows"] == [[1.0, None]]


def test_other_runs_are_sent_once(gateway: RunningGateway, watch: Watch) -> None:
    other = OtherRun(name="older", rows=[{"env_steps": 5.0, "entropy": 0.25}])
    gateway.call(lambda: setattr(gateway.data, "other_runs", lambda: [other]))
    viewer = watch()
    expected = {"type": "comparison", "name": "older", "columns": ["env_steps", "entropy"], "rows": [[5.0, 0.25]]}
    assert viewer.receive("comparison") == expected


def test_orders_need_the_operators_token(gateway: RunningGateway, watch: Watch) -> None:
    source, status = FakeSource(), run_status()
    gateway.call(lambda: setattr(gateway.data, "give_order", lambda *order: source.order(status, *order)))
    viewer = watch()
    viewer.send(type="order", order="stop", token="wrong")
    assert "not the operator's token" in viewer.receive("refused")["reason"]
    assert source.orders == []
    viewer.send(type="order", order="checkpoint", token=TOKEN)
    assert viewer.receive("ordered") == {
        "type": "ordered",
        "order": "checkpoint",
        "result": "checkpoint saved at 7 env_steps",
    }
    assert source.orders == [("checkpoint", "the operator")]


def test_an_order_that_the_learner_does_not_take_is_answered(gateway: RunningGateway, watch: Watch) -> None:
    viewer = watch()
    viewer.send(type="order", order="stop", token=TOKEN)
    assert viewer.receive("refused")["reason"] == "the learner was not reached yet: try again later"


@pytest.mark.parametrize(
    "message",
    [
        "",
        "[]",
        "{",
        '{"type": "hello"}',
        '{"type": ["hello"]}',
        '{"type": "order", "order": "delete", "token": ""}',
        '{"type": "order", "order": ["stop"], "token": ""}',
        '{"type": "camera", "on": 1}',
        '{"type": "hello", "token": ""}',
        "[" * 4000,
        b"\x00\x01",
    ],
)
def test_bad_messages_are_answered_and_at_last_end_the_connection(watch: Watch, message: str | bytes) -> None:
    viewer = watch()
    for _ in range(4):
        viewer.socket.send(message)
        assert viewer.receive("refused")["reason"]
    viewer.socket.send(message)
    assert viewer.receive("error")["code"] in ("malformed", "out_of_turn")
    assert viewer.closed() == 1008


@pytest.mark.parametrize("message", ['{"type": "hello", "token": "' + "x" * 5000 + '"}', b" " * 5000])
def test_large_message_ends_the_connection(watch: Watch, message: str | bytes) -> None:
    viewer = watch()
    viewer.socket.send(message)
    assert viewer.closed() == 1009


def test_first_message_must_be_a_hello(gateway: RunningGateway) -> None:
    with connect(f"ws://127.0.0.1:{gateway.port}/watch", open_timeout=LIMIT) as socket:
        socket.send('{"type": "camera", "on": true}')
        viewer = Viewer(socket)
        assert viewer.receive("error")["code"] == "out_of_turn"
        assert viewer.closed() == 1008


@pytest.mark.parametrize("token", ["", "wrong"])
def test_a_page_without_the_operators_token_reads_nothing(gateway: RunningGateway, watch: Watch, token: str) -> None:
    noted: list[bool] = []
    gateway.call(lambda: setattr(gateway.data, "on_watch", lambda watched: noted.append(watched) if watched else None))
    viewer = watch(token)
    message = json.loads(viewer.socket.recv(timeout=LIMIT))
    assert (message["type"], message["code"]) == ("error", "refused")
    assert viewer.closed() == 1008
    assert noted == []


def test_viewers_are_limited(gateway: RunningGateway, watch: Watch) -> None:
    gateway.call(lambda: setattr(gateway.data, "places", Places(1, "pages")))
    watch().receive("hello")
    second = watch()
    assert second.receive("error")["code"] == "unavailable"
    assert second.closed() == 1013


def test_somebody_watches_as_long_as_a_page_is_open(gateway: RunningGateway, watch: Watch) -> None:
    noted: list[bool] = []
    gateway.call(lambda: setattr(gateway.data, "on_watch", noted.append))
    viewer = watch()
    viewer.receive("hello")
    assert noted == [True]
    viewer.socket.close()
    until(lambda: noted == [True, False])


@pytest.mark.parametrize("path", ["/", "/play"])
def test_pages_name_files_that_exist_and_have_no_inline_script(gateway: RunningGateway, path: str) -> None:
    status, headers, content = fetch(gateway, path)
    assert status == 200
    assert "script-src 'self'" in headers["content-security-policy"]
    text = content.decode()
    assert "<script>" not in text
    assert "style=" not in text
    assert not re.search(r"\son\w+=", text)
    for name in {part.split('"')[0] for part in text.split("/page/")[1:]}:
        assert fetch(gateway, f"/page/{name}")[0] == 200


@pytest.mark.parametrize("path", ["/page/none.js", "/page/../server.py", "/page/%2e%2e%2fserver.py", "/page/", "/x"])
def test_other_files_are_not_served(gateway: RunningGateway, path: str) -> None:
    assert fetch(gateway, path)[0] == 404


def test_gateway_of_a_page_takes_no_clients(network: MemoryNetwork) -> None:
    with closing(RunningGateway(network, follows=False, takes_clients=False, reads_openly=False)) as running:
        assert fetch(running, "/")[0] == 200
        assert fetch(running, "/play")[0] == 403
        for path, reason in (("actor", b"this gateway serves its page only"), ("raw", b"")):
            with pytest.raises(InvalidStatus) as refused:
                connect(f"ws://127.0.0.1:{running.port}/{path}", open_timeout=LIMIT)
            assert refused.value.response.status_code == 403
            assert reason in (refused.value.response.body or b"")
        with connect(f"ws://127.0.0.1:{running.port}/watch", open_timeout=LIMIT) as socket:
            viewer = Viewer(socket)
            viewer.send(type="hello", token="")
            assert "start it with --operator-token FILE" in viewer.receive("error")["reason"]


@pytest.mark.parametrize("path", ["actor", "watch"])
@pytest.mark.parametrize("kind", ["order", "drain", "status", "query", "metrics", "events", "actors"])
def test_no_message_without_a_token_orders_or_asks_anything(
    gateway: RunningGateway, learner: ScriptedLearner, path: str, kind: str
) -> None:
    orders: list[str] = []
    gateway.call(lambda: setattr(gateway.data, "give_order", lambda order, _: orders.append(order) or ""))
    with connect(f"ws://127.0.0.1:{gateway.port}/{path}", open_timeout=LIMIT) as socket:
        socket.send(json.dumps({"type": kind, "order": "stop", "token": ""}))
        assert json.loads(socket.recv(timeout=LIMIT))["code"] in ("malformed", "out_of_turn")
        with pytest.raises(ConnectionClosed):
            socket.recv(timeout=LIMIT)
    assert orders == []


def test_pages_are_refused_under_another_name(gateway: RunningGateway) -> None:
    assert fetch(gateway, "/", Host="evil.example")[0] == 403


def test_beyond_loopback_a_page_needs_a_token_and_orders_that_of_an_operator(
    network: MemoryNetwork, tmp_path: Path
) -> None:
    made = make_certificates(tmp_path / "certs", "gateway", "client phone")
    phone = (made / "client-phone" / "token").read_text().strip()
    operator = (made / "operator" / "token").read_text().strip()
    running = RunningGateway(network, made / "gateway", follows=False)
    context = ssl.create_default_context(cafile=made / "gateway" / "ca.pem")
    orders: list[str] = []
    running.call(
        lambda: setattr(running.data, "give_order", lambda *order: (orders.append(" by ".join(order)) is None, ""))
    )
    try:
        for token, admitted in (("", False), ("wrong", False), (phone, True), (operator, True)):
            with connect(f"wss://127.0.0.1:{running.port}/watch", ssl=context, open_timeout=LIMIT) as socket:
                viewer = Viewer(socket)
                viewer.send(type="hello", token=token)
                assert viewer.receive("hello", "error")["type"] == ("hello" if admitted else "error")
                if admitted:
                    viewer.send(type="order", order="stop", token=token)
                    assert viewer.receive("ordered", "refused")["type"] == (
                        "ordered" if token == operator else "refused"
                    )
        assert orders == ["stop by operator operator"]
    finally:
        running.close()


def test_operators_tokens_are_issued_renewed_and_revoked_with_their_certificates(tmp_path: Path) -> None:
    made = make_certificates(tmp_path / "certs", "gateway", "operator alice")
    tokens, path = Tokens(made / "gateway"), made / "operator-alice" / "token"
    assert path.stat().st_mode & 0o077 == 0
    first = path.read_text().strip()
    tokens.check_operator(first)
    with pytest.raises(ClientError, match="not one of this name"):
        tokens.check("alice", first)  # it is not that of a client
    change_certificates(made, "renew operator alice")
    with pytest.raises(ClientError, match="needs an operator's token"):
        tokens.check_operator(first)
    second = path.read_text().strip()
    tokens.check_operator(second)
    change_certificates(made, "revoke operator alice")
    with pytest.raises(ClientError, match="needs an operator's token"):
        tokens.check_operator(second)
    assert not path.exists()


def test_expired_tokens_of_operators_and_viewers_are_refused(tmp_path: Path) -> None:
    operator, client = "an operator's token", "a client's token"
    entries = {"operator:alice": operator, "phone": client}
    for expires, refused in ((time.time() + 1000.0, False), (1.0, True)):
        record = {name: {"sha256": digest(token), "expires": expires} for name, token in entries.items()}
        (tmp_path / TOKENS).write_text(json.dumps(record))
        tokens = Tokens(tmp_path)
        for check, token in (
            (tokens.check_operator, operator),
            (tokens.check_viewer, operator),
            (tokens.check_viewer, client),
        ):
            with pytest.raises(ClientError, match="expired") if refused else nullcontext():
                check(token)


def test_operators_token_of_a_gateway_without_certificates(tmp_path: Path) -> None:
    path = tmp_path / "token"
    made = OperatorToken(path)
    assert path.stat().st_mode & 0o077 == 0
    token = path.read_text().strip()
    made.check_operator(token)
    OperatorToken(path).check_operator(token)  # it stays the same
    with pytest.raises(ClientError, match="not the operator's token"):
        made.check_operator(token + "x")
    path.write_text("short\n")
    with pytest.raises(ValueError, match="delete the file"):
        OperatorToken(path)
