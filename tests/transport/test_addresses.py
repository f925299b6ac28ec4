"""Addresses: which are allowed, which other hosts can connect to, and which only this user can reach."""

import os
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from processes import LIMIT, until

from daedalus.transport import addresses as module
from daedalus.transport.addresses import AddressError, check_connecting, check_listening, reachable, socket_path
from daedalus.transport.interface import TransportError
from daedalus.transport.private_address import private_address
from daedalus.transport.zenoh_transport import connect, listen


@pytest.mark.parametrize("address", ["tcp/127.0.0.1:7447", "tcp/127.8.9.1:1", "tcp/localhost:7447", "tcp/[::1]:7447"])
def test_loopback_needs_no_certificates(address: str) -> None:
    check_listening([address], tls=False, insecure=False)
    check_listening([address], tls=True, insecure=False)


@pytest.mark.parametrize("address", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.1:7447", "tcp/gpu-box:7447"])
def test_listening_beyond_loopback_needs_certificates_or_insecure(address: str) -> None:
    for tls, hint in ((False, "use certificates"), (True, "listen on tls/")):
        with pytest.raises(AddressError, match=f"{hint}.*--insecure"):
            check_listening(["tcp/127.0.0.1:1", address], tls=tls, insecure=False)
    check_listening([address], tls=False, insecure=True)
    check_listening([address.replace("tcp/", "tls/")], tls=True, insecure=False)


def test_protocol_must_fit_the_use_of_certificates() -> None:
    with pytest.raises(AddressError, match="needs certificates"):
        check_listening(["tls/127.0.0.1:1"], tls=False, insecure=True)
    with pytest.raises(AddressError, match="needs certificates"):
        check_connecting(["tls/h:1"], tls=False)
    with pytest.raises(AddressError, match="must begin with tls/"):
        check_connecting(["tcp/h:1"], tls=True)
    check_connecting(["tls/h:1", "tls/i:2"], tls=True)
    check_connecting(["tcp/h:1"], tls=False)


MALFORMED = ("", "h:1", "udp/h:1", "tcp/h", "tcp/:1", "tcp/h:x", "tcp/h:65536", "tls//h:-1")


@pytest.mark.parametrize(
    ("address", "message"),
    [
        *((address, r"is not an address: write tcp/HOST:PORT") for address in MALFORMED),
        ("tcp/127.0.0.1:0", "^tcp/127.0.0.1:0 has port 0: choose a port from 1 to 65535"),
        ("tls/h:00", "^tls/h:00 has port 0: choose a port from 1 to 65535"),
    ],
)
def test_address_that_cannot_be_used_is_refused_in_one_line(address: str, message: str) -> None:
    for check in (
        lambda: check_listening([address], tls=True, insecure=True),
        lambda: check_connecting([address], tls=address.startswith("tls")),
    ):
        with pytest.raises(AddressError, match=message):
            check()


def test_an_address_of_a_host_stays_as_it_is() -> None:
    addresses = ["tcp/127.0.0.1:7447", "tls/gpu-box.lan:7447", "tcp/[::1]:7447", "unixsock-stream/tmp/x/y"]
    assert reachable(addresses) == addresses


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "0:0:0:0:0:0:0:0"])
def test_an_unspecified_address_is_replaced_by_the_name_and_the_address_of_this_host(
    host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_own_address", lambda: ["192.168.1.7"])
    assert reachable([f"tcp/{host}:7447"]) == [f"tcp/{socket.gethostname()}:7447", "tcp/192.168.1.7:7447"]


def test_with_a_certificate_only_its_hosts_are_named() -> None:
    hosts = ["localhost", "127.0.0.1", "gpu-box.lan", "2001:db8::7"]
    assert reachable(["tls/0.0.0.0:1", "tcp/127.0.0.1:1"], hosts) == [
        *("tls/gpu-box.lan:1", "tls/[2001:db8::7]:1", "tcp/127.0.0.1:1")
    ]
    assert reachable(["tls/0.0.0.0:1"], hosts[:2]) == ["tls/localhost:1", "tls/127.0.0.1:1"]


def test_this_host_has_an_address_or_no_network() -> None:
    assert all(socket.inet_aton(address) for address in module._own_address())


def path_of(address: str) -> Path:
    path = socket_path(address)
    assert path is not None
    return Path(path)


def test_private_folder_belongs_to_this_user_alone_and_is_removed() -> None:
    with private_address() as address:
        folder = path_of(address).parent
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        check_listening([address], tls=False, insecure=False)
        check_connecting([address], tls=False)
        listen([address]).close()
    assert not folder.exists()


KILLED = """
import os, signal
from daedalus.transport.private_address import private_folder
with private_folder() as folder:
    open(os.path.join(folder, "learner"), "w").close()
    print(folder, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A folder whose path leaves room for that of a socket."""
    with tempfile.TemporaryDirectory(prefix="short-", dir="/tmp") as folder:
        yield Path(folder)


def test_folders_of_killed_processes_are_removed_by_the_next_one(
    short_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(short_path))
    monkeypatch.setattr(tempfile, "tempdir", str(short_path))
    with private_address() as address:
        alive = path_of(address).parent
        subprocess.run([sys.executable, "-c", KILLED], capture_output=True, check=False)
        (dead,) = (entry for entry in short_path.iterdir() if entry != alive)
        assert dead.name.startswith("daedalus-")
        home, theirs, unknown = short_path / "home", short_path / "daedalus-link", short_path / "daedalus-unknown"
        for folder in (home, unknown):
            folder.mkdir(mode=0o700)
        (home / "lock").touch(0o600)
        theirs.symlink_to(home)
        (dead / "link").symlink_to(home)

        def cleaned() -> bool:  # the server of multiprocessing ends a moment later
            with private_address():
                return not dead.exists()

        until(cleaned)
        assert {entry.name for entry in short_path.iterdir()} == {alive.name, home.name, theirs.name, unknown.name}
        assert (home / "lock").exists()


def test_private_path_is_short_enough_in_a_deep_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / ("d" * 80)
    deep.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(deep))
    with private_address() as address:
        assert path_of(address).parent.parent == Path("/tmp")
        listen([address]).close()


def test_everything_works_over_a_unix_socket_and_comes_back_after_a_restart() -> None:
    with private_address() as address, ExitStack() as stack:
        present: list[bool] = []
        news: list[bytes | None] = []
        router = listen([address])
        actor, learner = (stack.enter_context(closing(connect([address]))) for _ in range(2))
        learner.serve("d/r/rollouts/*", lambda request: request.reply(request.payload[::-1]))
        actor.watch_presence("d/r/learner", lambda _, there: present.append(there))
        inbox = actor.subscribe("d/r/snapshots", lambda: news.append(inbox.take()))
        learner.declare_presence("d/r/learner")
        for life in range(2):  # of the router
            until(lambda: present[-1:] == [True])
            until(lambda: actor.query("d/r/rollouts/a", bytes(10**6) + b"x", timeout=LIMIT) == [b"x" + bytes(10**6)])
            until(lambda: learner.publish("d/r/snapshots", b"new") or b"new" in news)
            if life == 0:
                router.close()
                until(lambda: present[-1:] == [False])
                news.clear()
                router = listen([address])
        router.close()


def open_to_others(folder: Path) -> None:
    folder.chmod(0o755)


def absent(folder: Path) -> None:
    folder.rmdir()


@pytest.mark.parametrize(
    ("spoil", "message"), [(open_to_others, "must be yours and mode 700"), (absent, "No such file or directory")]
)
def test_folder_that_others_may_enter_is_refused(tmp_path: Path, spoil: Callable[[Path], None], message: str) -> None:
    folder = tmp_path / "f"
    folder.mkdir(mode=0o700)
    check_listening([f"unixsock-stream/{folder}/s"], tls=False, insecure=False)
    spoil(folder)
    with pytest.raises(AddressError, match=message):
        check_listening([f"unixsock-stream/{folder}/s"], tls=False, insecure=True)


@pytest.mark.parametrize("path", ["relative/s", "", "/" + 98 * "x", "/tmp/a?b/s", "/tmp/a#b/s"])
def test_impossible_path_is_rejected(path: str) -> None:
    with pytest.raises(AddressError, match="absolute path of at most 98 bytes"):
        check_connecting([f"unixsock-stream/{path}"], tls=False)


def test_unreachable_sockets_are_reported(tmp_path: Path) -> None:
    with pytest.raises(TransportError, match=f"nothing answers at {tmp_path}/s"):
        connect([f"unixsock-stream/{tmp_path}/s"])


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
def test_another_user_cannot_reach_the_socket() -> None:
    with private_address() as address, closing(listen([address])):
        look = ["stat", str(path_of(address))]
        assert subprocess.run(look, capture_output=True, check=False).returncode == 0
        refused = subprocess.run(look, user=65_534, capture_output=True, text=True, check=False)
        assert "Permission denied" in refused.stderr


def test_socket_of_another_user_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr("socket.socket.connect", refuse)
    with pytest.raises(TransportError, match=f"{tmp_path}/s belongs to another user"):
        connect([f"unixsock-stream/{tmp_path}/s"])
