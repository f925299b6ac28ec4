"""Test of cli/commands/exporter.py: scrapes over a network, and mistakes on the command line."""

import contextlib
import socket
import sys
import threading
import urllib.request
from typing import Any

import pytest
from processes import LIMIT, until
from prometheus_client import CollectorRegistry
from statuses import run_status

from daedalus.cli.commands.exporter import exporter
from daedalus.launch import prometheus_exporter
from daedalus.launch.prometheus_exporter import StatusCollector
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import StatusReport
from daedalus.transport.interface import TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

UNUSED = "tcp/127.0.0.1:1"


def up(collector: StatusCollector) -> float | None:
    registry = CollectorRegistry()
    registry.register(collector)
    return registry.get_sample_value("daedalus_up")


@pytest.fixture
def collector(network: MemoryNetwork) -> StatusCollector:
    collector = StatusCollector()
    collector.transport = MemoryTransport(network)
    return collector


def test_each_scrape_queries_the_learners_again(network: MemoryNetwork, collector: StatusCollector) -> None:
    assert (up(collector), collector.unanswered) == (0.0, True)
    learner = MemoryTransport(network)
    answer = encode(StatusReport(status=run_status()))
    learner.serve(keys.status("mine"), lambda request: request.reply(answer))
    assert (up(collector), collector.unanswered) == (1.0, False)
    learner.close()
    assert (up(collector), collector.unanswered) == (0.0, True)


def test_no_learner_is_up_without_a_router() -> None:
    assert up(StatusCollector()) == 0.0


def test_an_invalid_answer_does_not_count_as_a_learner(network: MemoryNetwork, collector: StatusCollector) -> None:
    MemoryTransport(network).serve(keys.status("mine"), lambda request: request.reply(b"nonsense"))
    assert up(collector) == 0.0


def test_no_learner_is_up_if_the_transport_fails(collector: StatusCollector, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_arguments: object, **_options: object) -> list[bytes]:
        raise TransportError("closed")

    monkeypatch.setattr(collector.transport, "query", fail)
    assert up(collector) == 0.0


def test_registering_the_collector_queries_no_learner(collector: StatusCollector) -> None:
    CollectorRegistry().register(collector)
    assert not collector.unanswered


def test_a_missing_package_is_reported_with_the_extra_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    monkeypatch.delitem(sys.modules, "daedalus.launch.prometheus_exporter")
    assert exporter(["--connect", UNUSED]) == 1
    message = capsys.readouterr().err
    assert 'pip install "daedalus-rl[monitoring]"' in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("listen", ["9464", ":9464", "host:", "host:metrics", "host:65536"])
def test_an_invalid_listening_address_is_bad_usage(listen: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        exporter(["--connect", UNUSED, "--listen", listen])
    assert ended.value.code == 2
    assert "is not HOST:PORT" in capsys.readouterr().err


def test_an_address_in_use_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert exporter(["--connect", UNUSED, "--listen", f"127.0.0.1:{other.getsockname()[1]}"]) == 1
    assert "cannot listen on 127.0.0.1:" in capsys.readouterr().err


def test_silent_connections_keep_no_threads_and_nobody_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prometheus_exporter, "_MAX_CONNECTIONS", 3)
    monkeypatch.setattr(prometheus_exporter._Handler, "timeout", None)  # nothing but the limit ends a silent connection
    server = prometheus_exporter.MetricsServer("127.0.0.1", 0, CollectorRegistry())
    thread = threading.Thread(target=server.serve_forever)
    before = set(threading.enumerate())
    thread.start()

    def serving() -> int:
        """Count the threads of this server's connections only: earlier tests may have left threads that end now."""
        return sum("process_request_thread" in each.name for each in set(threading.enumerate()) - before)

    address = ("127.0.0.1", server.server_port)
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection(address, LIMIT)) for _ in range(8)]
        assert silent[0].recv(1) == b"", "the oldest is ended"
        with urllib.request.urlopen(f"http://127.0.0.1:{server.server_port}/metrics", timeout=LIMIT) as answer:
            assert answer.status == 200
        until(lambda: 0 < serving() <= 3)
    until(lambda: serving() == 0)
    server.shutdown()
    server.server_close()
    thread.join(LIMIT)


def test_silent_connections_end_before_one_that_has_asked(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(prometheus_exporter, "_MAX_CONNECTIONS", 3)
    asked, answer = threading.Event(), threading.Event()

    class SlowCollector:
        def collect(self) -> list[Any]:
            asked.set()
            answer.wait(LIMIT)
            return []

    registry = CollectorRegistry()
    server = prometheus_exporter.MetricsServer("127.0.0.1", 0, registry)
    registry.register(SlowCollector())
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    address = ("127.0.0.1", server.server_port)
    with contextlib.ExitStack() as stack:
        scrape = stack.enter_context(socket.create_connection(address, LIMIT))
        scrape.sendall(b"GET /metrics?\xff=%ff HTTP/1.1\r\nHost: \xff\r\n\r\n")
        assert asked.wait(LIMIT)
        silent = [stack.enter_context(socket.create_connection(address, LIMIT)) for _ in range(8)]
        assert all(one.recv(1) == b"" for one in silent[:6])
        answer.set()
        assert scrape.recv(65536).startswith(b"HTTP/1.0 200")
        for odd in (b"GET /\xff HTTP/1.1\r\n\r\n", b"\xff\xfe\r\n\r\n"):
            with socket.create_connection(address, LIMIT) as connection:
                connection.sendall(odd)
                connection.recv(1)
    server.shutdown()
    server.server_close()
    thread.join(LIMIT)
    assert capfd.readouterr().err == ""


def test_a_connection_that_says_nothing_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prometheus_exporter._Handler, "timeout", 0.1)
    server = prometheus_exporter.MetricsServer("127.0.0.1", 0, CollectorRegistry())
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    with socket.create_connection(("127.0.0.1", server.server_port), LIMIT) as silent:
        assert silent.recv(1) == b""
    server.shutdown()
    server.server_close()
    thread.join(LIMIT)
