"""Test of a real learner with mismatching actors and with arbitrary bytes."""

import re
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from faults import Faulty
from plain import vector_spaces
from processes import ENDLESS, LIMIT, PLAYING_SLOW, SLOW, Running, free_address, here, starting, until

from daedalus.protocol import keys
from daedalus.protocol.codec import PROTOCOL_VERSION, decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Join, Message, Refusal, Welcome
from daedalus.protocol.spaces import DiscreteSpace
from daedalus.transport.interface import Transport
from daedalus.transport.zenoh_transport import connect

CARTPOLE = vector_spaces(4, 2)
Start = Callable[..., Running]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a running learner, which the tests share."""
    address = free_address()
    with starting(tmp_path_factory.mktemp("learner")) as start:
        learner = start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS, *SLOW)
        learner.expect("actors join with")
        with closing(connect([address])) as transport:
            # The key that the learner serves last.
            until(lambda: transport.query(keys.join("run", "client"), timeout=30.0))
        yield address
        assert learner.process.poll() is None, learner.output


@pytest.fixture
def client(served: str) -> Iterator[Transport]:
    """Transport of a client that is connected to the learner."""
    with closing(connect([served])) as transport:
        yield transport


def ask(transport: Transport, key: str, payload: bytes) -> Message:
    (answer,) = transport.query(key, payload, timeout=LIMIT)
    return decode(answer, Limits())


def join(**kwargs: object) -> bytes:
    return encode(Join(actor="client", incarnation=1, **kwargs))  # type: ignore[arg-type] - fields of Join


def test_another_protocol_version_is_refused_and_both_versions_are_named(client: Transport) -> None:
    other = bytearray(join())
    struct.pack_into("<H", other, 4, PROTOCOL_VERSION + 1)
    answer = ask(client, keys.join("run", "client"), bytes(other))
    assert isinstance(answer, Refusal)
    assert answer.code == "mismatch"
    assert f"protocol version {PROTOCOL_VERSION + 1}" in answer.reason
    assert f"this one {PROTOCOL_VERSION}" in answer.reason


def test_a_foreign_join_that_comes_first_does_not_decide_the_spaces(client: Transport) -> None:
    """The learner's host can make the environment."""
    other = CARTPOLE.model_copy(update={"actions": {"action": DiscreteSpace(counts=(3,))}})
    answer = ask(client, keys.join("run", "client"), join(spaces=other, environments=2))
    assert isinstance(answer, Refusal)
    assert answer.code == "mismatch"
    assert "3 choices" in answer.reason
    assert "2 choices" in answer.reason
    assert isinstance(ask(client, keys.join("*", "client"), join(spaces=CARTPOLE, environments=2)), Welcome)


def test_a_second_actor_of_the_same_name_is_refused_while_the_first_takes_part(start: Start, served: str) -> None:
    actor = ("actor", "--connect", served, "--name", "arm", *PLAYING_SLOW)
    first = start(*actor)
    first.expect("joined run")
    second = start(*actor)
    second.expect("waiting for the other actor of this name to leave")
    assert second.wait() == 1
    second.expect("actor name 'arm' is already in use: choose another --name")
    third = start(*actor)
    third.expect("waiting for the other actor of this name to leave")
    first.end()
    third.expect("joined run 'run' as 'arm'")


def test_an_exception_in_a_zenoh_thread_of_an_actor_ends_it_and_not_its_learner(served: str) -> None:
    """That thread brings an answer. Further threads, also of learners: test_crashes.py."""
    fault = "daedalus.actor.session.uploading:InFlightRollouts.acknowledge"
    tests = Path(__file__).parent.parent  # with slow_environment
    Faulty(tests, "actor", fault, "--connect", served, *PLAYING_SLOW).assert_crashes()


def test_a_second_learner_of_the_same_run_is_refused(start: Start, served: str) -> None:
    second = start("learner", "cartpole", "--connect", served, "--run-dir", "two/run")
    assert second.wait() == 1
    second.expect("another learner already serves run 'run': stop that learner, or rename this run")


def test_where_the_learner_cannot_make_the_environment_a_refused_actor_prints_the_reason(
    start: Start, address: str, tmp_path: Path
) -> None:
    """The module is not in the learner's folder: the first actor decides the spaces."""
    (tmp_path / "slow_environment.py").unlink()
    learner = start("learner", "--env", "slow_environment:Slow-v0", "--listen", address, "--run-dir", "run")
    learner.expect("the first actor decides the spaces of the run, because .* cannot import slow_environment")
    learner.expect("actors join with")
    with closing(connect([address])) as transport:
        until(lambda: transport.query(keys.join("run", "client"), timeout=30.0))
        other = CARTPOLE.model_copy(update={"actions": {"action": DiscreteSpace(counts=(3,))}})
        assert isinstance(ask(transport, keys.join("run", "client"), join(spaces=other, environments=2)), Welcome)
        actor = start("actor", "--connect", address, *PLAYING_SLOW, directory=Path(__file__).parent.parent)
        assert actor.wait() == 1
        actor.expect("refused.*2 choices.*but this run has.*3 choices")
        status = here("status", "--connect", address, "--run", "run")
        status.expect(rf"refused: .* \({re.escape(socket.gethostname())}, daedalus-rl .*\), 1 x, ")
        status.expect("2 choices, but this run")
