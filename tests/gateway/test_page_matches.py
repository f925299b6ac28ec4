"""Matches of persons against the policy: what a viewer sends and receives, and what limits them."""

import functools
import json
import struct
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from gateways import RunningGateway
from processes import LIMIT, until
from scripted_learner import Policy
from websockets.sync.client import ClientConnection, connect

from daedalus.actor.evaluation.person_match import PersonMatch
from daedalus.gateway.learner_link import NewestPolicy
from daedalus.gateway.watching import person_matches as matches_module
from daedalus.gateway.watching.person_matches import Matches
from daedalus.gateway.watching.playing_process import PolicySource
from daedalus.policy.user_modules import NO_MODULES
from daedalus.protocol.messages import Snapshot, Welcome, program_hash
from daedalus.protocol.spec import RunSpec
from daedalus.transport.memory import MemoryNetwork

COMMAND = (sys.executable, "-P", "-m", "daedalus.launch.match_process")


@functools.cache
def policy_of(game: str, epoch: int = 1, version: int = 7) -> NewestPolicy:
    """Return a fresh policy of a game."""
    spec = RunSpec.model_validate({"environment": {"id": game}})
    match = PersonMatch(spec.for_actors(), NO_MODULES)
    match.close()
    policy = Policy.of(spec.policy, match.spaces)
    weights = {name: value.detach().numpy() for name, value in policy.network.named_parameters()}
    name = program_hash(policy.model)
    snapshot = Snapshot(learner_epoch=epoch, policy_version=version, program=name, weights=weights)
    welcome = Welcome(run="r", learner_epoch=epoch, seed=1, epsilon=0.0, spec=spec.for_actors())
    return NewestPolicy(session=welcome, program=policy.model, snapshot=snapshot)


class Person:
    """A page on which a person plays, spoken by hand."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket, self.facts = socket, dict[str, Any]()
        self.picture = b""
        self.send(type="hello", token="")

    def send(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def refused(self) -> str:
        """Return why the last order was refused."""
        while True:
            data = self.socket.recv(timeout=LIMIT)
            if isinstance(data, str) and (message := json.loads(data))["type"] in ("refused", "error"):
                return message["reason"]

    def frame(self) -> dict[str, Any]:
        """Return the facts of the next frame."""
        while isinstance(data := self.socket.recv(timeout=LIMIT), str):
            assert json.loads(data)["type"] != "refused", data
        (length,) = struct.unpack_from("<I", data)
        self.facts, self.picture = json.loads(data[4 : 4 + length]), data[4 + length :]
        return self.facts

    def begin(self, agent: str = "", *, sampled: bool = False) -> dict[str, Any]:
        self.send(type="match", agent=agent, sampled=sampled)
        return self.frame()

    def move(self, **action: list[float]) -> dict[str, Any]:
        self.send(type="move", turn=self.facts["turn"], action=action)
        return self.frame()


class Scene:
    """A gateway whose policy the test sets."""

    def __init__(self, network: MemoryNetwork) -> None:
        self.policy: NewestPolicy | None = None
        self.gateway = RunningGateway(network, follows=False)
        self.matches = Matches(COMMAND, PolicySource(lambda: self.policy))
        self.gateway.data.matches = self.matches
        self._stack = ExitStack()

    def person(self) -> Person:
        address = f"ws://127.0.0.1:{self.gateway.port}/watch"
        return Person(self._stack.enter_context(connect(address, open_timeout=LIMIT, max_size=None)))

    def close(self) -> None:
        self._stack.close()
        until(lambda: self.matches.places.taken == 0)
        self.gateway.close()


@pytest.fixture
def scene(network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    monkeypatch.setattr(matches_module, "_FETCH_SECONDS", 0.01)
    running = Scene(network)
    yield running
    running.close()


def test_a_match_is_played_to_its_end_and_again(scene: Scene) -> None:
    person = scene.person()
    assert "no policy yet" in person.begin()["error"]
    scene.policy = policy_of("pettingzoo.classic.connect_four_v3")
    facts = person.frame()
    facts = person.begin("player_1")
    assert (facts["agents"], facts["agent"], facts["version"]) == (["player_0", "player_1"], "player_1", 7)
    (opening,) = facts["moves"]
    assert opening[0] == "player_0"
    assert facts["board"]["rows"][5][opening[1]["action"][0]] == 1
    again = person.move(action=[99])
    assert (again["turn"], again["remark"]) == (0, "action must be whole numbers from 0, below 7")
    while not (facts := person.move(action=[facts["actions"][0]["choices"][0][0]]))["result"]:
        assert facts["remark"] == ""
    assert sum(facts["returns"].values()) == 0
    person.send(type="move", turn=facts["turn"], action={"action": [0]})
    assert "not your turn" in person.frame()["remark"]
    person.send(type="move", turn=0, action={"action": [0]})  # a move of before
    assert person.frame()["remark"] == ""
    scene.policy = policy_of("pettingzoo.classic.rps_v2", epoch=2, version=1)  # of another learner
    facts = person.begin()
    assert (facts["board"], facts["version"], facts["actions"][0]["choices"]) == (None, 1, [[0, 1, 2]])
    assert person.picture[:3] == b"\xff\xd8\xff"
    assert person.move(action=[1])["moves"][0][0] == "player_1"


BAD = [
    {"type": "match", "agent": "player_0"},
    {"type": "match", "agent": 1, "sampled": False},
    {"type": "match", "agent": "", "sampled": 0},
    {"type": "move", "turn": 0},
    {"type": "move", "turn": 0.0, "action": {}},
    {"type": "move", "turn": 0, "action": [1]},
    {"type": "move", "turn": 0, "action": {"action": 1}},
    {"type": "move", "turn": 0, "action": {"action": [True]}},
    {"type": "move", "turn": 0, "action": {"action": [float("nan")]}},
    {"type": "move", "turn": 0, "action": {"action": [10**400]}},
    {"type": "move", "turn": 0, "action": {"action": ["1"]}},
    {"type": "move", "turn": 0, "action": {"action": [[1]]}},
    {"type": "move", "turn": 0, "action": {"action": [1]}},  # without a match
]


def test_a_process_that_ends_at_once_is_not_started_again_and_again(scene: Scene, tmp_path: Path) -> None:
    starts = tmp_path / "starts"
    command = [sys.executable, "-c", f"open({str(starts)!r}, 'a').write('x')"]
    scene.matches = scene.gateway.data.matches = Matches(command, PolicySource(lambda: scene.policy))
    scene.policy = policy_of("pettingzoo.classic.connect_four_v3")
    person = scene.person()
    for number in (1, 2):
        assert "The process of the match has ended" in person.begin()["error"]
        assert starts.read_text() == "x" * number


def test_orders_that_are_malformed_or_too_early_start_nothing(scene: Scene) -> None:
    scene.policy = policy_of("pettingzoo.classic.tictactoe_v3")
    for message in BAD:
        person = scene.person()
        person.send(**message)
        assert person.refused(), message
        assert scene.matches.places.taken == 0


def test_moves_that_are_none_of_the_game_change_nothing(scene: Scene) -> None:
    scene.policy = policy_of("pettingzoo.classic.tictactoe_v3")
    person = scene.person()
    before = person.begin()
    bad: list[dict[str, Any]] = [{}, {"other": [1]}, *({"action": each} for each in ([], [0.5], [-1], [1e9]))]
    for action in bad:
        after = person.move(**action)
        assert after.pop("remark"), action
        assert {**after, "remark": ""} == before


def test_matches_are_limited_and_their_places_come_back(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene.matches.places, "_most", 1)
    scene.policy = policy_of("pettingzoo.classic.tictactoe_v3")
    first, second = scene.person(), scene.person()
    first.begin()
    second.send(type="match", agent="", sampled=False)
    assert "1 matches against the policy" in second.refused()
    with monkeypatch.context() as patch:
        patch.setattr(matches_module, "_IDLE_SECONDS", 0.2)
        first.move(action=[4])
        while "no move came" not in first.facts.get("error", ""):
            first.frame()
        until(lambda: scene.matches.places.taken == 0)
    assert second.begin()["turn"] == 0


def test_what_cannot_be_played_says_why(scene: Scene) -> None:
    person = scene.person()
    policy = policy_of("pettingzoo.classic.tictactoe_v3")

    def of(**changed: object) -> NewestPolicy:
        spec = policy.session.spec
        environment = spec.environment.model_copy(update=changed)
        session = replace(policy.session, spec=spec.model_copy(update={"environment": environment}))
        return replace(policy, session=session)

    scene.policy = of(id="CartPole-v1", backend="gymnasium")
    assert person.begin()["error"] == "The run plays CartPole-v1, which is no game with several agents."
    scene.policy = of(id="evil:make")
    assert "The match cannot be played: " in person.begin()["error"]
    scene.policy = policy
    while "turn" not in person.begin():  # the process that failed may not have ended
        pass
