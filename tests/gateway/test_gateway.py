"""The gateway over MemoryTransport: clients play, and their rollouts reach a learner."""

import asyncio
import contextlib
import json
import socket
import statistics
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from gateways import CARTPOLE, JsonClient, RunningGateway
from log_lines import LINES
from processes import LIMIT, until
from scripted_learner import SPEC, SYNCHRONOUS_SPEC, Policy, ScriptedLearner, acknowledge
from websockets.exceptions import ConnectionClosed

from daedalus.actor.environments.minari_files import MinariReader
from daedalus.gateway import client_gateway, connection, policy_versions, server
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_gateway import Gateway
from daedalus.gateway.client_messages import Act
from daedalus.policy.acting.runtime import Choice, OnnxRuntime, PolicyError
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.lessons import LessonPlan, LessonRange
from daedalus.protocol.messages import Acknowledgement, Refusal, RunEnded
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.transport import retries
from daedalus.transport.interface import Declaration, Request, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

Connect = Callable[..., JsonClient]
ROWS = 4


def fill_rollout(client: JsonClient, first: float = 0.0) -> list[int]:
    """Act until a rollout is full, from an observation that counts; return the actions."""
    answers = [
        client.act([first + step, 0.0, 0.0, 0.0], **({"reward": 1.0} if step else {})) for step in range(ROWS + 1)
    ]
    return [answer["action"] for answer in answers]


def ended(client: JsonClient) -> int:
    """Return the code with which the gateway closes the connection."""
    with pytest.raises(ConnectionClosed) as closed:
        client.receive()
    assert closed.value.rcvd is not None
    return closed.value.rcvd.code


@pytest.mark.skipif(not hasattr(socket, "TCP_QUICKACK"), reason="Linux")
def test_a_reward_before_an_act_is_acknowledged_at_once(learner: ScriptedLearner, connect: Connect) -> None:
    """A client without TCP_NODELAY sends the act when the reward is acknowledged: 40 ms later, by default."""
    client = connect()
    client.hello("arm-1")
    client.socket.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0)

    def median_seconds(step: Callable[[], object]) -> float:
        seconds = []
        for _ in range(60):  # the system acknowledges the first ones at once
            began = time.monotonic()
            step()
            seconds.append(time.monotonic() - began)
        return statistics.median(seconds)

    def in_two_messages() -> None:
        client.send("reward", reward=1.0)
        client.act([0.0] * 4)

    client.act([0.0] * 4)
    in_one = median_seconds(lambda: client.act([0.0] * 4, reward=1.0))
    in_two = median_seconds(in_two_messages)
    print(f"a step: {1e3 * in_one:.2f} ms in one message, {1e3 * in_two:.2f} ms in two")
    assert in_two < 3.0 * in_one + 0.02


def test_rollouts_of_a_client_reach_the_learner_under_its_name(learner: ScriptedLearner, connect: Connect) -> None:
    client = connect()
    welcome = client.hello("arm-1")
    assert welcome == {"type": "welcome", "version": 1, "run": "r", "environment": "CartPole-v1", "name": "arm-1"}
    actions = []
    for step in range(ROWS + 1):  # a rollout ends with a further observation
        answer = client.act([float(step), 0.0, 0.0, 0.0])
        actions.append(answer["action"])
        client.send("reward", reward=1.5)
        client.send("reward", reward=0.5)
    rollout, request = learner.receive()
    assert (rollout.identity.actor, rollout.identity.sequence) == ("arm-1", 0)
    assert rollout.frames["observation"][:, 0, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert rollout.actions["action"][:, 0, 0].tolist() == actions[:ROWS]
    assert rollout.rewards.tolist() == [[2.0]] * ROWS
    acknowledge(request, "accepted")
    joins = [learner.joins.get(timeout=1), learner.joins.get(timeout=1)]
    assert [(join.actor, join.environments) for join in joins] == [("gateway", 0), ("arm-1", 1)]
    assert joins[1].origin.address.startswith("ws/127.0.0.1:")


def test_end_of_an_episode_is_a_row_of_the_rollout(learner: ScriptedLearner, connect: Connect) -> None:
    client = connect()
    client.hello("arm-1")
    client.act([0.0, 0.0, 0.0, 0.0])
    client.send("end_episode", terminated=True, observation=[1.0, 0.0, 0.0, 0.0], reward=3.0)
    client.act([5.0, 0.0, 0.0, 0.0])
    client.act([6.0, 0.0, 0.0, 0.0], reward=1.0)
    client.send("end_episode", terminated=False, observation=[7.0, 0.0, 0.0, 0.0])
    rollout, _ = learner.receive()
    assert rollout.frames["observation"][:, 0, 0].tolist() == [0.0, 1.0, 5.0, 6.0, 7.0]
    assert rollout.terminated[:, 0].tolist() == [True, False, False, False]
    assert rollout.truncated[:, 0].tolist() == [False, False, False, True]
    assert rollout.valid[:, 0].tolist() == [True, False, True, True]
    assert rollout.rewards[:, 0].tolist() == [3.0, 0.0, 1.0, 0.0]


def test_a_client_plays_and_acknowledges_the_parameters_of_the_run(network: MemoryNetwork, connect: Connect) -> None:
    changed = {"environment": {**SPEC.environment.model_dump(), "parameters": {"speed": 1, "wind": 0.5}}}
    lessons = {"speed": {"between": [2, 9]}}
    learner = ScriptedLearner(network, RunSpec.model_validate({**SPEC.model_dump(), **changed, "lessons": lessons}))
    learner.lessons = LessonPlan(ranges={"speed": (LessonRange(low=4, high=6),)})
    learner.publish(0)
    client = connect()
    client.hello("arm-1")
    speeds = []
    for _ in range(8):
        refusal = client.act([0.0] * 4)
        assert refusal["code"] == "misfit"
        assert "ask for `parameters` before the first act" in refusal["reason"]
        for _ in range(2):  # the same for one episode
            client.send("parameters")
        answers = [client.receive() for _ in range(2)]
        assert answers[0] == answers[1]
        assert answers[0]["parameters"].keys() == {"speed", "wind"}
        speeds.append(answers[0]["parameters"]["speed"])
        client.act([0.0] * 4)
        client.send("end_episode", terminated=True)
    assert len(set(speeds)) > 1
    assert set(speeds) <= {4, 5, 6}
    rollout, _ = learner.receive()  # each episode has a row and a reset
    assert rollout.lessons["speed"].tolist() == speeds[: len(rollout.episode_returns)]
    assert len(rollout.episode_returns) == 2
    learner.transport.close()


def test_msgpack_clients_may_send_bytes_for_arrays(learner: ScriptedLearner, connect: Connect) -> None:
    client = connect()

    def ask(message: dict[str, Any]) -> dict[str, Any]:
        client.socket.send(bytes(msgpack.packb(message) or b""))
        answer = client.socket.recv(timeout=LIMIT)
        assert isinstance(answer, bytes)
        return msgpack.unpackb(answer)

    assert ask({"type": "hello", "version": 1, "name": "m", **CARTPOLE})["type"] == "welcome"
    for step in range(ROWS + 1):
        observation = np.array([step, 0.5, 0, 0], "<f4").tobytes()
        assert ask({"type": "act", "observation": observation})["action"] in (0, 1)
    rollout, _ = learner.receive()
    assert rollout.frames["observation"][3, 0].tolist() == [3.0, 0.5, 0.0, 0.0]


def test_clients_that_wait_are_chosen_for_in_one_call(
    learner: ScriptedLearner, gateway: RunningGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    clients = [connect() for _ in range(3)]
    for number, client in enumerate(clients):
        client.hello(f"c-{number}")
    rows: list[int] = []
    act = OnnxRuntime.act
    monkeypatch.setattr(OnnxRuntime, "act", lambda self, *given: rows.append(len(given[1])) or act(self, *given))

    async def act_together(inner: Gateway) -> list[Any]:
        actors = [seat.actor for seat in inner._seats.values()]
        actions: list[asyncio.Future[Any]] = [gateway.loop.create_future() for _ in actors]
        for actor, action in zip(actors, actions, strict=True):
            inner.act(actor, Act([1, 2, 3, 4], None, 0.0), action.set_result)
        return await asyncio.gather(*actions)

    together = asyncio.run_coroutine_threadsafe(act_together(gateway.gateway), gateway.loop)
    assert set(together.result(30)) <= {0, 1}
    assert rows == [3]


def test_samples_of_a_client_follow_the_seed_and_its_name(
    learner: ScriptedLearner, gateway: RunningGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of the first agent of a Client do."""
    drawn: list[np.ndarray] = []
    act = OnnxRuntime.act
    monkeypatch.setattr(OnnxRuntime, "act", lambda self, *given: drawn.append(given[2].uniform) or act(self, *given))
    for name in ("plumless", "buckeroo"):  # whose checksums by CRC-32 are equal
        client = connect()
        client.hello(name)
        fill_rollout(client)
        session = gateway.gateway._seats[name].actor._session
        assert session is not None
        random = np.random.default_rng((session.entropy(name), 0))
        expected = [random.random(2, np.float32) for _ in range(ROWS + 1)]
        np.testing.assert_array_equal(np.concatenate(drawn), expected)
        drawn.clear()
    assert session.entropy("plumless") != session.entropy("buckeroo")


def test_client_whose_action_cannot_be_sent_is_disconnected_and_the_others_act(
    learner: ScriptedLearner, gateway: RunningGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    clients = [connect() for _ in range(3)]
    for number, client in enumerate(clients):
        client.hello(f"c-{number}")
    take = ClientActor.take

    def failing(actor: ClientActor, choice: Choice) -> bool:
        if actor.name == "c-0":
            raise IndexError("no such component")
        return take(actor, choice)

    monkeypatch.setattr(ClientActor, "take", failing)
    for client in clients:
        client.send("act", observation=[1.0, 2.0, 3.0, 4.0])
    assert all(client.receive()["type"] == "action" for client in clients[1:])
    assert clients[0].receive() == {
        "type": "error",
        "code": "refused",
        "reason": "the gateway failed on an action (IndexError): see its log",
    }
    assert ended(clients[0]) == 1008
    assert clients[1].act([1.0, 2.0, 3.0, 4.0])["type"] == "action"


def test_each_rollout_has_the_newest_version_at_its_start(learner: ScriptedLearner, connect: Connect) -> None:
    client = connect()
    client.hello("arm-1")
    fill_rollout(client)
    rollout, request = learner.receive()
    assert rollout.policy_version == 0
    learner.publish(7, push=False)
    acknowledge(request, "accepted", version=7)  # the gateway fetches the version that it hears of
    versions, sequence = [], 0
    while 7 not in versions:
        fill_rollout(client)
        rollout, request = learner.receive()
        acknowledge(request, "accepted", version=7)
        versions.append(rollout.policy_version)
        sequence += 1
        assert rollout.identity.sequence == sequence
    assert set(versions) <= {0, 7}


def test_rollouts_wait_for_a_busy_learner_and_the_oldest_are_dropped(
    learner: ScriptedLearner, connect: Connect
) -> None:
    client = connect()
    client.hello("arm-1")
    for number in range(12):  # of which 2 are in flight, the window, and 8 wait
        fill_rollout(client, 100.0 * number)
    first, second = learner.receive(), learner.receive()
    assert learner.rollouts.empty()
    acknowledge(first[1], "busy")
    again, request = learner.receive()
    assert again.identity == first[0].identity
    acknowledge(request, "accepted")
    acknowledge(second[1], "accepted")
    third, _ = learner.receive()
    assert third.identity.sequence == 2
    assert third.frames["observation"][0, 0, 0] >= 400.0


def test_disconnected_client_is_absent_and_may_continue_its_rollout(
    learner: ScriptedLearner, gateway: RunningGateway, connect: Connect
) -> None:
    present: dict[str, bool] = {}
    learner.transport.watch_presence(keys.presence("r", "*", "*"), lambda key, there: present.update({key: there}))
    client = connect()
    client.hello("phone")
    for step in range(3):
        client.act([float(step), 0.0, 0.0, 0.0])
    assert list(present.values()) == [True]
    client.close()
    until(lambda: not any(present.values()))
    client = connect()
    assert client.hello("phone")["type"] == "welcome"
    assert list(present.values()) == [True], "the same incarnation"
    client.act([5.0, 0.0, 0.0, 0.0])
    client.act([6.0, 0.0, 0.0, 0.0])
    rollout, _ = learner.receive()
    assert rollout.frames["observation"][:, 0, 0].tolist() == [0.0, 1.0, 2.0, 5.0, 6.0]
    assert rollout.truncated[:, 0].tolist() == [False, True, False, False]
    assert rollout.valid[:, 0].tolist() == [True, True, False, True]


def test_silent_client_holds_up_nobody_and_loses_its_version_when_memory_is_needed(
    learner: ScriptedLearner, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_versions, "_MIN_VERSIONS", 2)
    monkeypatch.setattr(policy_versions, "_VERSION_BYTES", 0)
    monkeypatch.setattr(client_gateway, "_SLOW_SECONDS", 0.5)
    silent, busy = connect(), connect()
    silent.hello("silent")
    silent.act([0.0, 0.0, 0.0, 0.0])  # it now holds version 0
    busy.hello("busy")
    newest = version = 0
    while version < 2:  # there is no room for version 2 before version 0 is given up
        newest = version + 1
        learner.publish(newest, push=False)
        fill_rollout(busy)
        rollout, request = learner.receive()
        acknowledge(request, "accepted", version=newest)
        version = rollout.policy_version
    error = silent.receive()
    assert (error["type"], error["code"]) == ("error", "unavailable")
    assert ended(silent) == 1013


def test_clients_join_the_learner_that_returns(
    network: MemoryNetwork, learner: ScriptedLearner, connect: Connect
) -> None:
    client = connect()
    client.hello("arm-1")
    client.act([0.0, 0.0, 0.0, 0.0])
    learner.transport.close()
    assert client.act([1.0, 0.0, 0.0, 0.0])["type"] == "action", "the last policy acts while no learner is there"
    returned = ScriptedLearner(network, epoch=2)
    returned.publish(5)
    try:
        until(lambda: "arm-1" in [join.actor for join in list(returned.joins.queue)])
        filled = 0
        while returned.rollouts.empty():
            fill_rollout(client, 10.0)
            filled += 1
        rollout, request = returned.receive()
        assert (rollout.identity.learner_epoch, rollout.identity.sequence) == (2, 0)
        assert rollout.policy_version == 5
        client.send("end_episode", terminated=True)
        while not len(rollout.episode_lengths):
            acknowledge(request, "accepted", version=5)
            fill_rollout(client)
            rollout, request = returned.receive()
        assert rollout.episode_lengths[0] == 2 + (ROWS + 1) * filled, "also what it played for the learner before"
        assert rollout.episode_returns[0] == ROWS * filled
    finally:
        returned.transport.close()


def test_client_whose_presence_cannot_be_declared_is_refused(
    network: MemoryNetwork,
    learner: ScriptedLearner,
    gateway: RunningGateway,
    connect: Connect,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    client = connect()
    client.hello("arm-1")

    def fail(key: str) -> None:
        raise TransportError(f"cannot declare presence under {key}")

    monkeypatch.setattr(gateway.gateway._transport, "declare_presence", fail)
    learner.transport.close()
    other = ScriptedLearner(network, epoch=2, run="other")
    try:
        error = client.receive()
        assert error["code"] == "refused"
        assert "cannot declare presence under daedalus/other" in error["reason"]
        assert ended(client) == 1008
        assert connect().hello("arm-2")["code"] == "refused"
    finally:
        other.transport.close()


@pytest.mark.parametrize(
    ("verdict", "text"),
    [("quarantined", "the learner quarantined this client: why"), ("drained", "why: this client leaves the run")],
)
def test_verdict_on_a_client_ends_its_connection_and_says_why(
    learner: ScriptedLearner, connect: Connect, verdict: Any, text: str
) -> None:
    client = connect()
    client.hello("arm-1")
    fill_rollout(client)
    learner.receive()[1].reply(encode(Acknowledgement(verdict=verdict, reason="why")))
    error = client.receive()
    assert (error["type"], error["code"]) == ("error", "refused")
    assert text in error["reason"]
    assert ended(client) == 1008


def test_end_of_the_run_is_told_to_all_clients(learner: ScriptedLearner, connect: Connect) -> None:
    client = connect()
    client.hello("arm-1")
    message = RunEnded(learner_epoch=1, outcome="finished", reason="solved")
    learner.transport.publish(keys.run_end("r"), encode(message))
    assert client.receive() == {"type": "run_ended", "reason": "the run is over: solved"}
    assert ended(client) == 1000


def test_client_waits_for_a_learner(network: MemoryNetwork, connect: Connect) -> None:
    client = connect()
    client.send("hello", version=1, name="early", **CARTPOLE)
    learner = ScriptedLearner(network)
    try:
        until(lambda: learner.joins.qsize() >= 2)
        learner.publish(0)
        assert client.receive()["type"] == "welcome"
        assert client.act([0.0, 0.0, 0.0, 0.0])["type"] == "action"
    finally:
        learner.transport.close()


def test_client_that_disconnects_while_it_waits_for_a_learner_leaves_its_name(
    gateway: RunningGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client_gateway, "JOIN_SECONDS", 1e6)
    client = connect()
    client.send("hello", version=1, name="early", **CARTPOLE)
    client.send("act", observation=[0.0, 0.0, 0.0, 0.0])
    until(lambda: gateway.call(lambda: "early" in gateway.gateway._seats))
    client.close()
    until(lambda: gateway.call(lambda: not gateway.gateway._seats))


@pytest.mark.parametrize("early", [1, ROWS + 1])
def test_messages_that_come_before_the_answer_to_hello_are_answered_in_turn(
    network: MemoryNetwork, gateway: RunningGateway, connect: Connect, early: int
) -> None:
    client = connect()
    client.send("hello", version=1, name="early", **CARTPOLE)
    for step in range(early):
        client.send("act", observation=[float(step), 0.0, 0.0, 0.0])
    until(lambda: gateway.call(lambda: "early" in gateway.gateway._seats))
    learner = ScriptedLearner(network)
    learner.publish(0)
    try:
        assert [client.receive()["type"] for _ in range(1 + early)] == ["welcome", *["action"] * early]
        for step in range(early, ROWS + 1):
            client.act([float(step), 0.0, 0.0, 0.0])
        rollout, _ = learner.receive()
        assert rollout.frames["observation"][:, 0, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    finally:
        learner.transport.close()


def test_request_to_join_is_prepared_once_and_sent_again_until_it_is_answered(
    learner: ScriptedLearner, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared, asked = [], []
    prepare, answer = ClientActor.prepare, learner._join

    def unanswered_twice(request: Request) -> None:
        if request.key.endswith("/arm-1"):
            asked.append(request.key)
        if request.key not in asked or len(asked) == 3:
            answer(request)

    monkeypatch.setattr(ClientActor, "prepare", lambda actor, spec: prepared.append(spec) or prepare(actor, spec))
    learner.transport.serve(keys.join("r", "*"), unanswered_twice)
    assert connect().hello("arm-1")["type"] == "welcome"
    assert (len(prepared), len(asked)) == (1, 3)


def test_clients_act_while_the_link_takes_no_rollouts(
    learner: ScriptedLearner, gateway: RunningGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport = gateway.gateway._transport
    query_async, stalled, goes_on = transport.query_async, threading.Event(), threading.Event()

    def congested(*given: Any, **named: Any) -> None:
        stalled.set()
        assert goes_on.wait(LIMIT)
        query_async(*given, **named)

    client = connect()
    client.hello("arm-1")
    monkeypatch.setattr(transport, "query_async", congested)
    try:
        fill_rollout(client)
        assert stalled.wait(LIMIT)
        client.socket.send(json.dumps({"type": "act", "observation": [5.0, 0.0, 0.0, 0.0]}))
        assert json.loads(client.socket.recv(timeout=LIMIT / 2))["type"] == "action"
        fill_rollout(client)
    finally:
        goes_on.set()
    assert [learner.receive()[0].identity.sequence for _ in range(2)] == [0, 1]


def test_clients_act_while_the_link_takes_no_presence(
    learner: ScriptedLearner, gateway: RunningGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport = gateway.gateway._transport
    declare_presence, stalled, goes_on = transport.declare_presence, threading.Event(), threading.Event()

    def congested(key: str) -> Declaration:
        stalled.set()
        assert goes_on.wait(LIMIT)
        return declare_presence(key)

    client, late = connect(), connect()
    client.hello("arm-1")
    monkeypatch.setattr(transport, "declare_presence", congested)
    try:
        late.send("hello", version=1, name="arm-2", **CARTPOLE)
        assert stalled.wait(LIMIT)
        client.socket.send(json.dumps({"type": "act", "observation": [5.0, 0.0, 0.0, 0.0]}))
        assert json.loads(client.socket.recv(timeout=LIMIT / 2))["type"] == "action"
    finally:
        goes_on.set()
    assert late.receive()["type"] == "welcome"


def test_client_is_told_that_no_learner_came(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_gateway, "JOIN_SECONDS", 0.3)
    client = connect()
    error = client.hello("early")
    assert error["code"] == "unavailable"
    assert "no learner came" in error["reason"]


def test_refusal_of_the_learner_reaches_the_client(learner: ScriptedLearner, connect: Connect) -> None:
    until(lambda: not learner.joins.empty())
    learner.refusal = Refusal(code="mismatch", reason="the actor has 2 choices, but this run has 3 choices")
    client = connect()
    error = client.hello("arm-1")
    assert error["code"] == "refused"
    assert "2 choices, but this run has 3" in error["reason"]
    assert ended(client) == 1008


def test_clients_of_a_synchronous_run_go_on_between_updates_and_those_rows_are_not_sent(
    network: MemoryNetwork, connect: Connect
) -> None:
    learner = ScriptedLearner(network, SYNCHRONOUS_SPEC)
    learner.publish(0)
    try:
        client = connect()
        client.hello("arm-1")
        fill_rollout(client)
        first, request = learner.receive()
        acknowledge(request, "accepted")
        for step in range(2 * ROWS):
            assert client.act([100.0 + step, 0.0, 0.0, 0.0])["action"] in (0, 1)
        learner.publish(1)
        step = 200.0
        while learner.rollouts.empty():  # until the gateway has the new version, and a rollout is full
            client.act([step, 0.0, 0.0, 0.0], reward=1.0)
            step += 1.0
        second, _ = learner.receive()
        assert [rollout.policy_version for rollout in (first, second)] == [0, 1]
        assert second.identity.sequence == 1
        begin = second.frames["observation"][0, 0, 0]
        assert begin >= 200.0
        assert second.frames["observation"][:, 0, 0].tolist() == [begin + row for row in range(ROWS + 1)]
        assert second.rewards.tolist() == [[1.0]] * ROWS
    finally:
        learner.transport.close()


def test_episodes_of_clients_are_recorded(network: MemoryNetwork, learner: ScriptedLearner, tmp_path: Path) -> None:
    running = RunningGateway(network, record=str(tmp_path / "played"))
    with contextlib.closing(running), contextlib.closing(JsonClient(running.port)) as client:
        with contextlib.closing(JsonClient(running.port)) as other:  # which the learner refuses: it plays nothing
            learner.refusal = Refusal(code="mismatch", reason="the actor has 3 choices")
            other.hello("arm-2", {**CARTPOLE, "actions": {"action": {"kind": "discrete", "counts": [3]}}})
            learner.refusal = None
        client.hello("arm-1")
        played = [client.act([0.0, 0.0, 0.0, 0.0], override=1)["action"]]
        played.append(client.act([1.0, 0.0, 0.0, 0.0], reward=1.0)["action"])
        client.send("reward", reward=0.5)
        client.send("end_episode", terminated=True, observation=[2.0, 0.0, 0.0, 0.0], reward=1.0)
        client.act([9.0, 0.0, 0.0, 0.0])  # its episode is cut: nobody knows how it would have ended
    with MinariReader(str(tmp_path / "played")) as dataset:
        (episode,) = dataset
    assert episode.observations[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert (episode.actions.tolist(), episode.rewards.tolist(), episode.terminated) == (played, [1.0, 1.5], True)


def test_override_is_the_action_and_its_row_is_marked(learner: ScriptedLearner, connect: Connect) -> None:
    client, message = connect(), {"reward": 1.0}
    client.hello("arm-1")
    assert client.act([0.0, 0.0, 0.0, 0.0], override=1)["action"] == 1, "no rollout begins with it"
    client.act([1.0, 0.0, 0.0, 0.0], **message)
    for action in (0, 1):
        assert client.act([2.0 + action, 0.0, 0.0, 0.0], **message, override=action)["action"] == action
    assert "outside its space" in client.act([9.0, 0.0, 0.0, 0.0], **message, override=2)["reason"]
    client.act([4.0, 0.0, 0.0, 0.0], **message)
    client.act([5.0, 0.0, 0.0, 0.0], **message)
    rollout, request = learner.receive()
    acknowledge(request, "accepted")
    assert rollout.frames["observation"][:, 0, 0].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert rollout.overridden is not None
    assert rollout.overridden[:, 0].tolist() == [False, True, True, False]
    assert rollout.rewards.tolist() == [[1.0]] * ROWS
    while (report := learner.reports.get(timeout=LIMIT)).overridden_actions < 3:
        pass
    assert report.actor == "arm-1"


def test_name_belongs_to_one_client_at_a_time(learner: ScriptedLearner, connect: Connect) -> None:
    first, second = connect(), connect()
    first.hello("arm-1")
    assert "a client named 'arm-1' is connected" in second.hello("arm-1")["reason"]
    assert first.act([0.0, 0.0, 0.0, 0.0])["type"] == "action"


@pytest.mark.parametrize("name", ["", "a/b", "*", "é", "x" * 65, "<b>"])
def test_name_that_is_no_part_of_a_key_is_refused(learner: ScriptedLearner, connect: Connect, name: str) -> None:
    assert "name must be 1 to 64 letters" in connect().hello(name)["reason"]


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"type": "act", "observation": [1, 2, 3]}, "the observation has 3 values, but its space is float32 array"),
        ({"type": "act", "observation": ["a"] * 4}, "not an array of numbers"),
        ({"type": "act", "observation": [1e300, 0, 0, 0]}, "a value beyond"),
        ({"type": "act", "observation": [[1, 2], 3]}, "not an array of numbers"),
        ({"type": "act"}, "act lacks the field 'observation'"),
        ({"type": "act", "observation": [0] * 4, "action_mask": [1, 1]}, "no action is masked in the hello"),
        ({"type": "act", "observation": [0] * 4, "reward": "1"}, "a reward must be a number"),
        ({"type": "act", "observation": [0] * 4, "more": 1}, "act has an unknown field 'more'"),
        ({"type": "hello", "version": 1, "name": "b", **CARTPOLE}, "hello is out of turn: a connection has one hello"),
        ({"type": "reward", "reward": 1e300}, "the reward is 1e+300: it must be finite"),
        ({"type": "end_episode", "terminated": False}, "a truncated episode needs its last observation"),
        ({"type": "end_episode", "terminated": 1}, "terminated must be true or false"),
        ({"type": "fly"}, "the message has no type that a client sends"),
        ("nonsense", "the message has no type that a client sends"),
    ],
)
def test_wrong_message_is_answered_and_nothing_is_lost(
    learner: ScriptedLearner, connect: Connect, fields: Any, text: str
) -> None:
    client = connect()
    client.hello("arm-1")
    client.act([0.0, 0.0, 0.0, 0.0])
    client.socket.send(json.dumps(fields))
    error = client.receive()
    assert error["type"] == "error"
    assert text in error["reason"]
    for step in range(1, ROWS + 1):
        client.act([float(step), 0.0, 0.0, 0.0], reward=1.0)
    rollout, _ = learner.receive()
    assert rollout.frames["observation"][:, 0, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert rollout.rewards[:, 0].tolist() == [1.0] * ROWS


def test_reward_of_a_refused_message_does_not_count(network: MemoryNetwork, connect: Connect) -> None:
    spaces = {
        "observations": {
            "action_mask": {"kind": "array", "shape": [2], "dtype": "float32"},
            "place": {"kind": "array", "shape": [1], "dtype": "float32"},
        },
        "actions": CARTPOLE["actions"],
    }
    spec = SPEC.model_copy(update={"environment": SPEC.environment.model_copy(update={"bootstrap_terminations": True})})
    choice = DiscreteSpace(counts=(2,), masked=True)
    seen = Spaces(observations={"place": ArraySpace(shape=(1,), dtype="float32")}, actions={"action": choice})
    learner = ScriptedLearner(network, spec, policy=Policy.of(spec.policy, seen))
    learner.publish(0)
    try:
        client = connect()
        client.hello("arm-1", spaces)

        def act(place: float, mask: tuple[int, int] = (1, 1), **fields: Any) -> dict[str, Any]:
            return client.act({"place": [place], "action_mask": list(mask)}, **fields)

        act(0.0)
        assert "forbids every choice" in act(1.0, (0, 0), reward=1.0)["reason"]
        act(1.0, reward=1.0)
        client.send("end_episode", terminated=True, reward=1.0)
        assert "pass the last observation" in client.receive()["reason"]
        client.send("end_episode", terminated=True, reward=1.0, observation={"place": [2.0], "action_mask": [0, 0]})
        for place in (5.0, 6.0):
            act(place)
        rollout, _ = learner.receive()
        assert rollout.rewards[:, 0].tolist() == [1.0, 1.0, 0.0, 0.0]
        assert rollout.episode_returns.tolist() == [2.0]
    finally:
        learner.transport.close()


def test_client_with_many_faults_is_disconnected(learner: ScriptedLearner, connect: Connect) -> None:
    client = connect()
    client.hello("arm-1")
    for _ in range(10):
        client.send("fly")
        assert client.receive()["code"] == "malformed"
    assert ended(client) == 1008


@pytest.mark.parametrize("data", ["{", "[" * 100_000, b"\xc1", b"", '{"type": NaN}', "1" * 5000])
def test_damaged_first_message_ends_the_connection(learner: ScriptedLearner, connect: Connect, data: Any) -> None:
    client = connect()
    client.socket.send(data)
    answer = client.socket.recv(timeout=LIMIT)
    decoded = msgpack.unpackb(answer) if isinstance(answer, bytes) else json.loads(answer)
    assert decoded["code"] == "malformed"
    assert ended(client) == 1008


def test_message_larger_than_the_spaces_need_ends_the_connection(learner: ScriptedLearner, connect: Connect) -> None:
    client = connect()
    client.hello("arm-1")
    client.socket.send(" " * 10_000)
    assert ended(client) == 1009


def test_message_of_too_many_fragments_ends_the_connection(
    learner: ScriptedLearner, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_MAX_FRAGMENTS", 10)
    client = connect()
    client.hello("arm-1")
    client.socket.send(["{", *[""] * 7, "}"])  # the library adds an empty fragment, the last
    assert client.receive()["code"] == "malformed"
    client.socket.send(["{", *[""] * 8, "}"])
    assert ended(client) == 1009


def test_connection_without_a_hello_is_closed(
    learner: ScriptedLearner, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "HELLO_SECONDS", 0.2)
    client = connect()
    assert "no hello came" in client.receive()["reason"]
    assert ended(client) == 1008


def test_gateway_stops_while_clients_play(learner: ScriptedLearner, network: MemoryNetwork) -> None:
    running = RunningGateway(network)
    client = JsonClient(running.port)
    client.hello("arm-1")
    client.act([0.0, 0.0, 0.0, 0.0])
    running.close()
    assert client.receive() == {"type": "error", "code": "unavailable", "reason": "the gateway stops"}
    client.close()


def test_client_that_returns_while_the_gateway_stops_is_refused(
    learner: ScriptedLearner, network: MemoryNetwork
) -> None:
    running = RunningGateway(network)
    client = JsonClient(running.port)
    client.hello("arm-1")
    asyncio.run_coroutine_threadsafe(running.gateway.close(), running.loop).result(LIMIT)
    returned = JsonClient(running.port)
    assert returned.hello("arm-1") == {"type": "error", "code": "unavailable", "reason": "the gateway stops"}
    assert ended(returned) == 1013
    running.close()
    client.close()
    returned.close()


@pytest.fixture
def quick_retries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retries, "_FIRST_PAUSE_SECONDS", 0.01)
    monkeypatch.setattr(retries, "_MAX_PAUSE_SECONDS", 0.01)


@pytest.mark.usefixtures("quick_retries")
def test_a_gateway_outlives_a_second_run_and_another_release(network: MemoryNetwork, connect: Connect) -> None:
    foreign = MemoryTransport(network)
    newer = bytearray(encode(Refusal(code="not_ready", reason="")))
    newer[4] += 1
    foreign.serve(keys.join("three", "*"), lambda request: request.reply(bytes(newer)))
    until(lambda: any(line.startswith("the other end uses protocol version") for line in LINES))
    with network.lock:  # the gateway would follow the one that it finds alone
        first, second = ScriptedLearner(network, run="one"), ScriptedLearner(network, run="two")
    until(lambda: any(line.startswith("several learners answer here (one, two)") for line in LINES))
    first.transport.close()
    foreign.close()
    second.publish(0)
    assert connect().hello("arm-1")["run"] == "two"


@pytest.mark.usefixtures("quick_retries")
def test_a_policy_that_does_not_run_ends_its_clients_and_not_the_gateway(
    learner: ScriptedLearner, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = connect()
    client.hello("arm-1")
    act = OnnxRuntime.act

    def fail(*_: object) -> None:
        raise PolicyError("the policy takes longer than 30 s")

    monkeypatch.setattr(OnnxRuntime, "act", fail)
    client.send("act", observation=[0.0, 0.0, 0.0, 0.0])
    answer = client.receive()
    assert (answer["type"], answer["code"]) == ("error", "unavailable")
    until(lambda: any(join.failure == "the policy takes longer than 30 s" for join in list(learner.joins.queue)))
    monkeypatch.setattr(OnnxRuntime, "act", act)
    again = connect()
    again.hello("arm-1")
    assert "action" in again.act([0.0, 0.0, 0.0, 0.0])
