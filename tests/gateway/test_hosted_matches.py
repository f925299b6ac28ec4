"""A game engine that hosts matches and holds their seats over one WebSocket: rows, steps, and bad input."""

import queue
from typing import Any

import numpy as np
import pytest
import scripted_games
from gateways import JsonClient, RunningGateway
from processes import LIMIT
from scripted_learner import Policy, ScriptedLearner, acknowledge
from test_protocol import check

from daedalus.protocol.codec import decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, ObservationSpaces, Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout
from daedalus.transport.memory import MemoryNetwork

SPACES = {
    "observations": {"observation": {"kind": "array", "shape": [3], "dtype": "float32"}},
    "actions": {"action": {"kind": "discrete", "counts": [5]}},
}
LENGTH = 5


def learner_of(network: MemoryNetwork, count: int, **environment: Any) -> ScriptedLearner:
    """Return a learner of a game that engines host."""
    settings = {"id": "engine", "backend": "pettingzoo", "agent_ids": True, **environment}
    spec = RunSpec.model_validate({"environment": settings, "collection": {"rollout_length": LENGTH, "window": 64}})
    observations: ObservationSpaces = {"observation": ArraySpace(shape=(3,), dtype="float32")}
    if settings["agent_ids"]:
        observations["agent"] = DiscreteSpace(counts=(count,))
    spaces = Spaces(observations=observations, actions={"action": DiscreteSpace(counts=(5,))})
    learner = ScriptedLearner(network, spec, policy=Policy.of(spec.policy, spaces))
    learner.publish(0)
    return learner


class Engine(JsonClient):
    """An engine that plays the matches of scripted_games."""

    def __init__(self, port: int, agents: int) -> None:
        super().__init__(port)
        self.seats = [f"agent_{number}" for number in range(agents)]
        self.played: dict[scripted_games.Key, int] = {}

    def receive(self) -> dict[str, Any]:
        message = super().receive()
        check(message, "gateway")
        return message

    def send(self, kind: str, **fields: Any) -> None:
        if kind != "hello" or fields.get("version") == 1:
            check({"type": kind, **fields}, "client")
        super().send(kind, **fields)

    def join(self, *, turns: bool) -> dict[str, Any]:
        return self.hello("engine", SPACES, match={"seats": self.seats, "turns": turns})

    def play(self, seed: int, number: int, *, together: bool) -> None:
        """Play one match. The agents of a step ask for their actions at once, and take the answers in any order."""
        _, steps = scripted_games.match(seed, number, len(self.seats), together=together)
        taken = dict.fromkeys(range(len(self.seats)), 0)
        for step in steps:
            for agent in step.actors:
                observation = [float(number), float(agent), float(taken[agent])]
                self.send("act", seat=self.seats[agent], observation=observation)
            for _ in step.actors:
                answer = self.receive()
                agent = self.seats.index(answer["seat"])
                self.played[number, agent, taken[agent]] = answer["action"]
                taken[agent] += 1
            for agent, reward in step.rewards.items():
                if taken[agent]:
                    self.send("reward", seat=self.seats[agent], reward=reward)
            for agent in (*step.terminated, *step.truncated):
                last = [float(number), float(agent), float(taken[agent])]
                fields = {"terminated": agent in step.terminated, "observation": last}
                self.send("end_episode", seat=self.seats[agent], **fields)


def received(learner: ScriptedLearner) -> list[Rollout]:
    """Return the rollouts that came, and acknowledge them."""
    found = []
    while True:
        try:
            request = learner.rollouts.get(timeout=0.3)
        except queue.Empty:
            return found
        rollout = decode(request.payload, Limits())
        assert isinstance(rollout, Rollout)
        acknowledge(request, "accepted")
        found.append(rollout)


@pytest.mark.parametrize("together", [False, True], ids=["in turns", "together"])
@pytest.mark.parametrize("seed", range(3))
def test_rows_of_hosted_seats_are_those_of_a_slow_account(
    network: MemoryNetwork, gateway: RunningGateway, seed: int, together: bool
) -> None:
    agents = 2 + seed % 2
    learner = learner_of(network, agents)
    engine = Engine(gateway.port, agents)
    try:
        assert engine.join(turns=not together)["type"] == "welcome"
        for number in range(12):
            engine.play(seed, number, together=together)
        rollouts = received(learner)
    finally:
        engine.close()
        learner.transport.close()
    seen = set[scripted_games.Key]()
    assert {rollout.identity.actor for rollout in rollouts} == {f"engine.{seat}" for seat in engine.seats}
    for rollout in rollouts:
        begun = 0  # steps of the game whose first action is in this rollout
        for row in np.flatnonzero(rollout.valid[:, 0]):
            number, agent, taken = (int(value) for value in rollout.frames["observation"][row, 0])
            key = (number, agent, taken)
            assert rollout.identity.actor == f"engine.agent_{agent}"
            assert rollout.frames["agent"][row, 0].tolist() == [agent]
            assert key not in seen
            seen.add(key)
            wanted = scripted_games.rows(seed, number, agents, together=together)[key]
            assert rollout.actions["action"][row, 0, 0] == engine.played[key]
            assert rollout.rewards[row, 0] == wanted.reward
            assert rollout.terminated[row, 0] == wanted.terminated
            assert rollout.truncated[row, 0] == wanted.truncated
            _, steps = scripted_games.match(seed, number, agents, together=together)
            begun += steps[wanted.step].actors[0] == agent
        assert rollout.game_steps == (begun if together else None)
        assert rollout.env_steps == begun
    assert len(seen) > len(engine.played) / 2


def test_a_seat_may_act_while_others_wait_and_after_it_has_ended(
    network: MemoryNetwork, gateway: RunningGateway
) -> None:
    learner = learner_of(network, 2)
    engine = Engine(gateway.port, 2)
    first, second = engine.seats
    engine.join(turns=False)
    for seat in (first, second, first, second):  # the second actions wait for the answers to the first ones
        engine.send("act", seat=seat, observation=[0.0, 0.0, 0.0])
    assert sorted(engine.receive()["seat"] for _ in range(4)) == [first, first, second, second]
    engine.send("end_episode", seat=first, terminated=True)
    assert engine.act([1.0, 0.0, 0.0], seat=second)["seat"] == second
    engine.send("end_episode", seat=first, terminated=True)
    fault = engine.receive()
    assert (fault["code"], fault["reason"][:27]) == ("out_of_turn", "end_episode is out of turn:")
    assert engine.act([1.0, 0.0, 0.0], seat=first)["seat"] == first
    engine.close()
    learner.transport.close()


SEATS = ["agent_0", "agent_1"]


BAD: list[tuple[Any, str]] = [
    (SEATS, "match must have seats"),
    ({"seats": SEATS}, "match must have seats"),
    ({"seats": SEATS, "turns": 1}, "match must have seats"),
    ({"seats": SEATS, "turns": True, "side": 1}, "match must have seats"),
    ({"seats": "agent_0", "turns": True}, "match must have seats"),
    ({"seats": [], "turns": True}, "from 1 to 64 seats"),
    ({"seats": [f"a{number}" for number in range(65)], "turns": True}, "from 1 to 64 seats"),
    ({"seats": ["agent_0", "agent_0"], "turns": True}, "the same name"),
    ({"seats": ["agent_0", "a/b"], "turns": True}, "'a/b' is no name"),
    ({"seats": ["agent_0", 1], "turns": True}, "the seat 1 is no name"),
    ({"seats": ["agent_0", "x" * 60], "turns": True}, "name must be 1 to 64"),
    ({"seats": ["agent_0", "other"], "turns": True}, "the policy does not play 'other'"),
]


def test_matches_that_are_none_are_refused(network: MemoryNetwork, gateway: RunningGateway) -> None:
    learner = learner_of(network, 2, agents=SEATS)
    for match, reason in BAD:
        client = JsonClient(gateway.port)
        answer = client.hello("engine", SPACES, match=match)
        assert answer["type"] == "error"
        assert reason in answer["reason"]
        client.close()
    learner.transport.close()


def test_messages_about_a_seat_that_does_not_exist_change_nothing(
    network: MemoryNetwork, gateway: RunningGateway
) -> None:
    learner = learner_of(network, 2)
    engine = JsonClient(gateway.port)
    engine.hello("engine", SPACES, match={"seats": SEATS, "turns": True})
    for seat in ({}, {"seat": "other"}, {"seat": None}, {"seat": 0}, {"seat": ["agent_0"]}, {"seat": ""}):
        answer = engine.act([0.0] * 3, **seat)
        assert (answer["type"], answer["code"]) == ("error", "misfit")
        assert "the match of the hello has agent_0, agent_1" in answer["reason"]
    answer = engine.act([0.0], seat="agent_1")  # a fault of a seat names it
    assert (answer["type"], answer["seat"]) == ("error", "agent_1")
    assert engine.act([0.0] * 3, seat="agent_1")["type"] == "action"
    engine.close()
    learner.transport.close()


def test_runs_that_cannot_take_a_match_say_why(network: MemoryNetwork, gateway: RunningGateway) -> None:
    learner = learner_of(network, 2)
    plain = JsonClient(gateway.port)
    assert "environment.agent_ids" in plain.hello("plain", SPACES)["reason"]
    plain.close()
    learner.transport.close()


def test_seats_that_act_together_need_a_run_of_a_game(network: MemoryNetwork, gateway: RunningGateway) -> None:
    learner = learner_of(network, 2, backend="gymnasium", agent_ids=False)
    engine = Engine(gateway.port, 2)
    assert "start the learner with --set environment.backend=pettingzoo" in engine.join(turns=False)["reason"]
    engine.close()
    engine = Engine(gateway.port, 2)
    assert engine.join(turns=True)["type"] == "welcome"
    engine.close()
    learner.transport.close()


def test_each_seat_is_an_actor_whose_name_nobody_else_has(network: MemoryNetwork, gateway: RunningGateway) -> None:
    learner = learner_of(network, 2)
    engine = JsonClient(gateway.port)
    assert engine.hello("engine", SPACES, match={"seats": SEATS, "turns": True})["type"] == "welcome"
    joined = {learner.joins.get(timeout=LIMIT).actor for _ in range(3)}
    assert joined == {"gateway", "engine.agent_0", "engine.agent_1"}
    again = JsonClient(gateway.port)
    assert "is connected" in again.hello("engine.agent_0", SPACES)["reason"]
    again.close()
    engine.close()
    learner.transport.close()
