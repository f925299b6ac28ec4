"""Permissions of each role over real TLS on a real router, and rejected certificates."""

import datetime
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from certificates import change_certificates, issue_expired, make_certificates, unchecked
from routers import listen_somewhere

from daedalus.cli.commands.router import router
from daedalus.learner.serving.actor_server import LOOK
from daedalus.protocol import keys
from daedalus.transport.credentials import (
    CredentialsError,
    NotValidNowError,
    credentials_to_listen,
    load,
    run_for,
    with_remedy,
)
from daedalus.transport.interface import RefusedError, Transport, TransportError
from daedalus.transport.zenoh_transport import connect, listen

LIMIT = 60.0
DENIED_SECONDS = 1.0  # to wait for an answer that must not arrive


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificates(tmp_path_factory.mktemp("tls") / "certs")


@pytest.fixture(scope="module")
def strange(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return certificates of another CA, with the same names."""
    return make_certificates(tmp_path_factory.mktemp("strange") / "certs")


@pytest.fixture(scope="module")
def address(certificates: Path) -> Iterator[str]:
    """Run a router, and a learner that is its client and answers every query."""
    where, router = listen_somewhere(certificates / "router")
    with closing(router), closing(connect([where], load(certificates / "learner", "learner"))) as learner:
        for key in (
            keys.join("r", "*"),
            keys.rollouts("r", "*"),
            keys.reports("r", "*"),
            keys.evaluations("r", "*"),
            keys.program("r", "*"),
            keys.snapshots("r"),
            keys.status("r"),
            keys.orders("r", "*"),
        ):
            learner.serve(key, lambda request: request.reply(b"the learner's"))
        yield where


IDENTITIES = {
    "learner": ("learner", "learner", "learner"),  # folder, role, name for uploads
    "actor": ("actor-arm", "actor", "arm"),
    "one of an actor's host": ("actor-arm", "actor", "arm.3"),
    "another actor": ("actor-box", "actor", "box"),
    "operator": ("operator", "operator", "operator"),
}


class Scene:
    """A transport with the tested identity, and a learner and an actor that observe it."""

    def __init__(self, address: str, certificates: Path, identity: str, stack: ExitStack, *, allowed: bool) -> None:
        self.allowed = allowed
        self.patience = LIMIT if allowed else DENIED_SECONDS
        folder, role, self.name = IDENTITIES[identity]

        def session(folder: str, role: str) -> Transport:
            return stack.enter_context(closing(connect([address], load(certificates / folder, role))))

        self.own = session(folder, role)
        self.learner, self.actor = session("learner", "learner"), session("actor-box", "actor")

    def answered(self, key: str) -> bool:
        return self.own.query(key, b"x", timeout=self.patience) == [b"the learner's"]

    def arrives(self, end: Transport, other: Transport, key: str) -> bool:
        """Return whether a value that `end` publishes on a key reaches `other`, which receives the learner's values."""
        news: list[bytes] = []
        inbox = other.subscribe(key, lambda: news.append(inbox.take() or b""))
        self.until_heard(lambda: self.learner.publish(key, b"first"), lambda: b"first" in news)
        end.publish(key, b"second")
        end.query(keys.join("r", self.name), timeout=self.patience)  # returns after everything sent before has arrived
        self.until_heard(lambda: self.learner.publish(key, b"third"), lambda: b"third" in news)
        return b"second" in news

    def until_received(self, key: str) -> None:
        """Subscribe to a key on which the learner publishes, and wait for a value."""
        news: list[bytes] = []
        inbox = self.own.subscribe(key, lambda: news.append(inbox.take() or b""))
        self.until_heard(lambda: self.learner.publish(key, b"new"), lambda: bool(news))

    @staticmethod
    def until_heard(say: Callable[[], None], heard: Callable[[], bool]) -> None:
        deadline = time.monotonic() + LIMIT
        while not heard():
            assert time.monotonic() < deadline
            say()
            time.sleep(0.02)


def joins(scene: Scene) -> bool:
    queried = [keys.join("r", scene.name), keys.join("*", scene.name), keys.program("r", "*")]
    return all(scene.answered(key) for key in queried)


def joins_as_another(scene: Scene) -> bool:
    return any(scene.answered(keys.join(run, name)) for run in ("r", "*") for name in others(scene))


def others(scene: Scene) -> list[str]:
    """Return names that are not the owner's, though some look like it."""
    own = scene.name.partition(".")[0]
    other = "arm" if own == "box" else "box"
    return [other, f"{own}x", f"{other}.{own}", "*"]


def uploads_as_itself(scene: Scene) -> bool:
    return all(scene.answered(key_of("r", scene.name)) for key_of in (keys.rollouts, keys.reports, keys.evaluations))


def uploads_as_another(scene: Scene) -> bool:
    queried = [
        key_of("r", name) for key_of in (keys.rollouts, keys.reports, keys.evaluations) for name in others(scene)
    ]
    return any(scene.answered(key) for key in queried)


def reads_publications(scene: Scene) -> bool:
    if not scene.answered(keys.snapshots("r")):
        return False
    for key in (keys.snapshots("r"), keys.run_end("r")):
        scene.until_received(key)
    return True


def publishes(scene: Scene) -> bool:
    return any(scene.arrives(scene.own, scene.actor, key) for key in (keys.snapshots("r"), keys.run_end("r")))


def answers_joins(scene: Scene) -> bool:
    scene.own.serve(keys.join("fake", "*"), lambda request: request.reply(b"come to me"))
    scene.own.query(keys.join("r", scene.name), timeout=scene.patience)
    return scene.actor.query(keys.join("fake", "box"), timeout=scene.patience) == [b"come to me"]


def answers_status(scene: Scene) -> bool:
    """As a newer learner would: the learner of the run steps down for it."""
    scene.own.serve(keys.status("fake"), lambda request: request.reply(b"I am newer"))
    scene.own.serve("daedalus/*/status", lambda request: request.reply(b"I am newer"))
    scene.own.query(keys.join("r", scene.name), timeout=scene.patience)
    return b"I am newer" in scene.learner.query(keys.status("fake"), LOOK, timeout=scene.patience)


def watches_presence(scene: Scene) -> bool:
    seen: list[str] = []
    sure: list[str] = []
    scene.own.watch_presence(keys.presence("r", "*", "*"), lambda key, _: seen.append(key))
    scene.learner.watch_presence(keys.presence("r", "*", "*"), lambda key, _: sure.append(key))
    scene.actor.declare_presence(keys.presence("r", "box", 7))
    scene.until_heard(lambda: None, lambda: bool(sure))
    if scene.allowed:
        scene.until_heard(lambda: None, lambda: bool(seen))
    else:
        scene.own.query(keys.join("r", scene.name), timeout=DENIED_SECONDS)
        time.sleep(0.1)
    return bool(seen)


def reads_the_status(scene: Scene) -> bool:
    return scene.answered(keys.status("r"))


def gives_orders(scene: Scene) -> bool:
    return scene.answered(keys.orders("r", scene.name))


def gives_orders_as_another(scene: Scene) -> bool:
    """As another operator, as nobody, or to all runs at once."""
    keys_of_others = [keys.orders("r", name) for name in ("alice", keys.NO_OPERATOR, "*")]
    return any(scene.answered(key) for key in keys_of_others)


def drains_waiting_actors(scene: Scene) -> bool:
    """An actor that waits for a run shows itself, and an operator reaches it."""
    news: list[bytes] = []
    waiting = keys.presence(keys.NO_RUN, "box", 7)
    inbox = scene.actor.subscribe(keys.orders(keys.NO_RUN, "*"), lambda: news.append(inbox.take() or b""))
    scene.actor.declare_presence(waiting)
    scene.until_heard(lambda: None, lambda: waiting in scene.learner.present(keys.presence(keys.NO_RUN, "*", "*")))
    sees = waiting in scene.own.present(keys.presence(keys.NO_RUN, "*", "*"))
    scene.until_heard(
        lambda: scene.learner.publish(keys.orders(keys.NO_RUN, "learner"), b"first"), lambda: b"first" in news
    )
    scene.own.publish(keys.orders(keys.NO_RUN, scene.name), b"second")
    scene.own.query(keys.join("r", scene.name), timeout=scene.patience)
    scene.until_heard(
        lambda: scene.learner.publish(keys.orders(keys.NO_RUN, "learner"), b"third"), lambda: b"third" in news
    )
    return sees and b"second" in news


OPERATIONS = (
    joins,
    joins_as_another,
    uploads_as_itself,
    uploads_as_another,
    reads_publications,
    publishes,
    answers_joins,
    answers_status,
    watches_presence,
    reads_the_status,
    gives_orders,
    gives_orders_as_another,
    drains_waiting_actors,
)
PLAYS = {joins, uploads_as_itself, reads_publications}
ALLOWED = {
    "learner": set(OPERATIONS),
    "actor": PLAYS,
    "one of an actor's host": PLAYS,
    "another actor": PLAYS,
    "operator": {watches_presence, reads_the_status, gives_orders, drains_waiting_actors},
}


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda operation: operation.__name__)
@pytest.mark.parametrize("identity", IDENTITIES)
def test_table_of_permissions(
    address: str, certificates: Path, identity: str, operation: Callable[[Scene], bool]
) -> None:
    with ExitStack() as stack:
        allowed = operation in ALLOWED[identity]
        assert operation(Scene(address, certificates, identity, stack, allowed=allowed)) == allowed


def test_every_identity_sees_the_learner_disappear(address: str, certificates: Path) -> None:
    with ExitStack() as stack:
        scene = Scene(address, certificates, "actor", stack, allowed=True)
        there: list[bool] = []
        scene.own.watch_presence(keys.learner("r"), lambda _, present: there.append(present))
        scene.learner.declare_presence(keys.learner("r"))
        scene.until_heard(lambda: None, lambda: there == [True])
        scene.learner.close()
        scene.until_heard(lambda: None, lambda: there == [True, False])


# --------------------------------------------------------------------------------------------- certificates of one run


@pytest.fixture(scope="module")
def users(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return certificates of two users, each for runs of their own, and of an operator and an actor of all runs."""
    words = ("learner alice bob", "operator ann --run alice", "actor arm --run alice", "actor box")
    return make_certificates(tmp_path_factory.mktemp("users") / "certs", *words)


def test_a_certificate_of_one_run_keeps_it_apart_from_the_others(users: Path) -> None:
    address, router = listen_somewhere(users / "router")
    with closing(router), ExitStack() as stack:

        def end(folder: str) -> Transport:
            credentials = load(users / folder, folder.partition("-")[0])
            return stack.enter_context(closing(connect([address], credentials)))

        alice, bob, ann, arm, box = map(end, ("learner-alice", "learner-bob", "operator-ann", "actor-arm", "actor-box"))
        everything = end("operator")

        def served(run: str, name: str) -> list[tuple[str, str]]:
            return [
                (keys.join(run, name), "actor"),
                (keys.rollouts(run, name), "actor"),
                (keys.snapshots(run), "actor"),
                (keys.program(run, "x"), "actor"),
                (keys.status(run), "operator"),
                (keys.orders(run, "ann"), "operator"),
            ]

        for run in ("alice", "alice.2", "bob"):
            for key, _ in served(run, "*"):
                alice.serve(key, lambda request: request.reply(b"alice"))  # also where it must not
                if run == "bob":
                    bob.serve(key, lambda request: request.reply(b"bob"))
        for run in ("alice", "alice.2"):
            for key, role in served(run, "arm"):
                asks = arm if role == "actor" else ann
                assert asks.query(key, b"x", timeout=LIMIT) == [b"alice"], key
                assert bob.query(key, b"x", timeout=DENIED_SECONDS) == [], key
        for key, role in served("bob", "arm"):
            asks = arm if role == "actor" else ann
            assert asks.query(key, b"x", timeout=DENIED_SECONDS / 2) == [], key
        assert box.query(keys.join("bob", "box"), b"x", timeout=LIMIT) == [b"bob"], "alice cannot answer for bob"
        assert sorted(box.query(keys.join("*", "box"), b"x", timeout=LIMIT)) == [b"alice", b"alice", b"bob"]
        assert sorted(everything.query(keys.status("*"), b"x", timeout=LIMIT)) == [b"alice", b"alice", b"bob"]
        news: list[bytes] = []
        inbox = box.subscribe(keys.snapshots("bob"), lambda: news.append(inbox.take() or b""))

        def publish() -> None:
            alice.publish(keys.snapshots("bob"), b"forged")
            bob.publish(keys.snapshots("bob"), b"bob")

        Scene.until_heard(publish, lambda: len(news) > 5)
        assert set(news) == {b"bob"}
        read: list[bytes] = []
        spying = alice.subscribe(keys.snapshots("bob"), lambda: read.append(spying.take() or b""))
        present: list[str] = []
        alice.watch_presence(keys.presence("bob", "*", "*"), lambda key, _: present.append(key))
        box.declare_presence(keys.presence("bob", "box", 1))
        bob.publish(keys.snapshots("bob"), b"secret")
        bob.query(keys.join("bob", "box"), b"x", timeout=LIMIT)  # returns after everything sent before has arrived
        alice.query(keys.join("alice", "arm"), b"x", timeout=LIMIT)
        assert (read, present) == ([], [])


def test_a_learner_of_one_run_does_not_listen_nor_serve_another(users: Path) -> None:
    folder = users / "learner-alice"
    with pytest.raises(CredentialsError, match=r"for the run 'alice' only, which may not listen: start a router"):
        credentials_to_listen(["tls/127.0.0.1:1"], folder, "learner", insecure=False)
    alice = load(folder, "learner")
    assert [run_for(alice, run) for run in ("*", "alice", "alice.2")] == ["alice", "alice", "alice.2"]
    assert run_for(load(users / "learner", "learner"), "bob") == "bob"
    with pytest.raises(CredentialsError, match=r"is not for the run 'bob', only for 'alice' and alice\.ANYTHING"):
        run_for(alice, "bob")


# ------------------------------------------------------------------------------------- unknown identities and mistakes


def test_certificate_of_another_ca_is_rejected(address: str, strange: Path) -> None:
    with pytest.raises(RefusedError, match="different CAs"):
        connect([address], load(strange / "actor-arm", "actor"))
    with pytest.raises(TransportError, match="requires --tls"):
        connect([address.replace("tls/", "tcp/")])


def test_foreign_certificate_with_our_ca_file_is_rejected(
    address: str, certificates: Path, strange: Path, tmp_path: Path
) -> None:
    """The client trusts our CA, but its certificate is signed by another one."""
    folder = shutil.copytree(strange / "actor-box", tmp_path / "actor-box")
    shutil.copyfile(certificates / "actor-box" / "ca.pem", folder / "ca.pem")
    with pytest.raises(RefusedError, match=r"refuses the certificate in .*revoked, or issued after the service's copy"):
        connect([address], load(folder, "actor"))


def test_expired_certificate_is_rejected_when_loaded(certificates: Path) -> None:
    with pytest.raises(
        CredentialsError,
        match=r"the certificate expired on \d{4}-\d\d-\d\d \d\d:\d\d UTC, and the clock of this host says .*: renew it",
    ):
        load(issue_expired(certificates, "actor", "arm"), "actor")


def test_expired_certificate_is_refused_with_a_reason(address: str, certificates: Path) -> None:
    with pytest.raises(RefusedError, match=r"expired-actor: the certificate expired on .*: renew it"):
        connect([address], unchecked(issue_expired(certificates, "actor", "arm")))


def test_listener_with_an_expired_certificate_is_not_trusted(certificates: Path) -> None:
    address, router = listen_somewhere(issue_expired(certificates, "router"))
    with closing(router), pytest.raises(RefusedError) as raised:
        connect([address], load(certificates / "actor-arm", "actor"))
    assert f"the certificate of the router at {address} cannot be verified: it expired on" in str(raised.value)


def test_a_clock_that_is_wrong_is_named_at_both_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For a clock that is behind, certificates are not valid yet; the other end has no clock that it could compare."""
    certificates = make_certificates(tmp_path / "certs")
    address, router = listen_somewhere(certificates / "router")
    with monkeypatch.context() as patch:
        patch.setattr("daedalus.launch.certificates._CLOCK_SKEW", datetime.timedelta(days=-1))
        actor, listener = (issue_expired(certificates, *who, days=9) for who in (("actor", "arm"), ("router",)))
    not_yet = rf"is not valid before 20.* the clock of this host says {time.strftime('%Y-%m-%d', time.gmtime())}"
    with pytest.raises(NotValidNowError, match=not_yet):
        load(actor, "actor")
    where, early = listen_somewhere(listener)
    with (
        closing(early),
        pytest.raises(RefusedError, match=f"the certificate of the router at {where} .*: it {not_yet}"),
    ):
        connect([where], load(certificates / "actor-box", "actor"))
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 2 * 86_400)  # the clock of the actor, and of nobody else
    with closing(router), pytest.raises(RefusedError, match=r"as expired or not yet valid, and by the clock of this"):
        connect([address], unchecked(actor))


def test_actor_certificate_cannot_be_used_by_a_learner(certificates: Path, tmp_path: Path) -> None:
    """The learner refuses to start with it, and an actor refuses to connect to it."""
    with pytest.raises(CredentialsError, match="holds the certificate of actor 'arm', but learner is required"):
        load(certificates / "actor-arm", "learner")
    folder = shutil.copytree(certificates / "actor-arm", tmp_path / "actor-arm")
    shutil.copyfile(certificates / "router" / "clients.pem", folder / "clients.pem")
    address, router = listen_somewhere(folder)
    with closing(router), pytest.raises(RefusedError, match="cannot be verified"):
        connect([address], load(certificates / "actor-box", "actor"))


def test_gateway_certificate_is_neither_a_learners_nor_a_clients(certificates: Path, tmp_path: Path) -> None:
    """Not even on the learner's own host: gateways have another CA, which no actor and no listener trusts."""
    # A copy: what is issued changes the files of the router at `address`, which would close all its connections.
    certificates = shutil.copytree(certificates, tmp_path / "certs")
    change_certificates(certificates, "issue gateway")
    folder = certificates / "gateway"
    with pytest.raises(CredentialsError, match="holds the certificate of gateway, but learner is required"):
        load(folder, "learner")
    shutil.copyfile(certificates / "router" / "clients.pem", folder / "clients.pem")
    address, impostor = listen_somewhere(folder)
    with closing(impostor), pytest.raises(RefusedError, match=r"cannot be verified: .*different CAs"):
        connect([address], load(certificates / "actor-box", "actor"))
    address, router = listen_somewhere(certificates / "router")
    shutil.copyfile(certificates / "actor-box" / "ca.pem", folder / "ca.pem")
    with closing(router), pytest.raises(RefusedError, match="refuses the certificate"):
        connect([address], unchecked(folder, "gateway", ""))


def test_host_missing_in_the_certificate_is_not_trusted(certificates: Path) -> None:
    address, router = listen_somewhere(certificates / "router")
    port = address.rpartition(":")[2]
    with closing(router):
        pass
    other = f"tls/127.0.0.3:{port}"
    with (
        closing(listen([other], credentials=load(certificates / "router", "router"))),
        pytest.raises(RefusedError, match=r"mismatch.*--host"),
    ):
        connect([other], load(certificates / "actor-arm", "actor"))


def replace_by_pipe(folder: Path) -> None:
    (folder / "ca.pem").unlink()
    os.mkfifo(folder / "ca.pem")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "key.pem").unlink(), "has no key.pem"),
        (replace_by_pipe, "has no ca.pem"),
        (lambda folder: (folder / "key.pem").write_text("x"), "is damaged"),
        (lambda folder: (folder / "certificate.pem").write_bytes(b"\xff"), "is damaged"),
        (lambda folder: (folder / "ca.pem").write_text("x"), "ca.pem is damaged"),
    ],
)
def test_damaged_folder_is_reported(tmp_path: Path, damage: Callable[[Path], object], message: str) -> None:
    folder = make_certificates(tmp_path / "certs") / "actor-arm"
    damage(folder)
    with pytest.raises(CredentialsError, match=message):
        load(folder, "actor")


def test_remedy_for_a_certificate_of_the_future_is_the_clock() -> None:
    assert "check the clock of this host" in with_remedy("certificate is not yet valid")


def test_file_that_another_user_owns_is_reported(certificates: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: Path, mode: str) -> None:  # a test may run as root, who may read everything
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(CredentialsError, match=r"ca\.pem: Permission denied: let the user of this process read it"):
        load(certificates / "actor-arm", "actor")


def test_folder_that_is_damaged_after_the_start_is_reported_when_the_process_connects_again(
    address: str, tmp_path: Path, certificates: Path
) -> None:
    folder = shutil.copytree(certificates / "actor-arm", tmp_path / "actor-arm")
    credentials = load(folder, "actor")
    with closing(connect([address], credentials)) as actor:
        (folder / "key.pem").write_text("x")
        with pytest.raises(TransportError, match=r"actor-arm cannot be used any more: copy the folder") as raised:
            actor.reopen()
    assert not isinstance(raised.value, RefusedError), "the files may still be being copied: it tries again"


def test_key_of_another_certificate_is_reported(certificates: Path, tmp_path: Path) -> None:
    for name, source in (("ca.pem", "actor-arm"), ("certificate.pem", "actor-arm"), ("key.pem", "actor-box")):
        (tmp_path / name).write_bytes((certificates / source / name).read_bytes())
    with pytest.raises(CredentialsError, match=r"key.pem is not the key of certificate.pem"):
        load(tmp_path, "actor")


@pytest.mark.parametrize("text", ["", "-----BEGIN CERTIFICATE-----\n", "\0"])
def test_listener_without_authorised_clients_does_not_start(tmp_path: Path, text: str) -> None:
    folder = make_certificates(tmp_path / "certs") / "learner"
    (folder / "clients.pem").write_text(text)
    with pytest.raises(CredentialsError, match=r"no readable clients\.pem"):
        listen(["tls/127.0.0.1:0"], credentials=load(folder, "learner"))


def test_a_certificate_that_is_not_valid_now_is_no_bad_usage(
    certificates: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever supervises the process must start it again: the certificate may be renewed."""
    expired = issue_expired(certificates, "router")
    assert router(["--listen", "tls/127.0.0.1:1", "--tls", str(expired)]) == 1
    assert "expired on" in capsys.readouterr().err
    assert router(["--listen", "tls/127.0.0.1:1", "--tls", str(certificates)]) == 2
