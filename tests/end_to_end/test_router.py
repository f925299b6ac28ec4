"""A router on its own, as a process."""

import socket
from collections.abc import Callable

import pytest
from processes import Running

Start = Callable[..., Running]


@pytest.fixture
def other_address() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def test_a_router_says_where_it_listens_and_ends_when_told(start: Start, address: str) -> None:
    router = start("router", "--listen", address)
    router.expect(f"listening on {address}")
    second = start("router", "--listen", address)
    assert second.wait() == 1
    second.expect(f"daedalus router: address {address} is already in use")
    router.process.terminate()
    assert router.wait() == 0
    assert len(router.lines) == 1


def test_two_routers_carry_a_run_between_them_in_whatever_order_they_start(
    start: Start, address: str, other_address: str
) -> None:
    start("router", "--listen", other_address, "--connect", address).expect("listening")
    learner = start("learner", "cartpole", "--connect", other_address, "--run-dir", "run", "--env-steps", 30000)
    actor = start("actor", "--connect", address)
    start("router", "--listen", address)
    assert learner.wait() == 3, learner.output
    assert actor.wait() == 0, actor.output
