"""The protocol against its schema, and against every order of messages."""

import importlib.resources
import itertools
import json
from typing import Any, get_args

import jsonschema
import pytest
from gateways import CARTPOLE, JsonClient, RunningGateway
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test
from scripted_learner import ScriptedLearner

from daedalus.gateway import client_messages
from daedalus.gateway.client_messages import ClientError, ErrorCode
from daedalus.protocol.releases import own_release
from daedalus.transport.memory import MemoryNetwork

SCHEMA = json.loads(importlib.resources.files("daedalus.gateway").joinpath("protocol.json").read_text())
OBSERVATION = [0.1, 0.2, 0.3, 0.4]
LEGAL = {  # written out again, independent of the code
    "new": {"hello"},
    "between episodes": {"parameters", "act"},
    "in an episode": {"act", "reward", "end_episode"},
}
MESSAGES: dict[str, dict[str, Any]] = {
    "hello": {"version": 1, "name": "any", **CARTPOLE},
    "parameters": {},
    "act": {"observation": OBSERVATION},
    "reward": {"reward": 0.5},
    "end_episode": {"terminated": True, "observation": OBSERVATION},
}

VALIDATORS = {
    side: jsonschema.Draft202012Validator({"$ref": f"#/$defs/{side}", "$defs": SCHEMA["$defs"]})
    for side in ("client", "gateway")
}
NUMBERS = itertools.count()


def check(message: dict[str, Any], side: str) -> None:
    """Fail if a message is not one of the schema."""
    VALIDATORS[side].validate(message)


def test_schema_is_one_and_knows_every_message_and_code() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert [entry["$ref"].rpartition("/")[2] for entry in SCHEMA["$defs"]["client"]["oneOf"]] == list(
        client_messages._FIELDS
    )
    assert SCHEMA["$defs"]["error"]["properties"]["code"]["enum"] == list(get_args(ErrorCode))
    for kind, (required, optional) in client_messages._FIELDS.items():
        definition = SCHEMA["$defs"][kind]
        assert set(definition["required"]) == {"type", *required}
        assert set(definition["properties"]) == {"type", *required, *optional}


@pytest.mark.parametrize("kind", list(MESSAGES))
def test_examples_fit_the_schema(kind: str) -> None:
    check({"type": kind, **MESSAGES[kind]}, "client")


@pytest.mark.parametrize(
    ("version", "remedy"),
    [(2, "upgrade the gateway"), (0, "use the client files of "), ("x" * 90, "use the client files of ")],
)
def test_a_client_of_another_version_reads_which_release_it_needs(version: object, remedy: str) -> None:
    hello = {"type": "hello", **MESSAGES["hello"], "version": version}
    with pytest.raises(ClientError) as refused:
        client_messages.read(json.dumps(hello), {"": "new"})
    assert f", the gateway 1, which {own_release()} has: {remedy}" in refused.value.reason
    assert len(refused.value.reason) < 200


class AnyOrder(RuleBasedStateMachine):
    """Messages in any order: legal ones are obeyed, and all others are answered by an error and change nothing."""

    gateway: RunningGateway

    def __init__(self) -> None:
        super().__init__()
        self.client = JsonClient(self.gateway.port)
        self.state, self.faults = "new", 0

    @rule(kind=st.sampled_from(["hello", "parameters", "act", "act", "act", "reward", "end_episode"]))
    def send(self, kind: str) -> None:
        if self.state == "closed":
            self.client = JsonClient(self.gateway.port)
            self.state, self.faults = "new", 0
        fields = {**MESSAGES[kind], **({"name": f"client-{next(NUMBERS)}"} if kind == "hello" else {})}
        self.client.send(kind, **fields)
        if kind not in LEGAL[self.state]:
            self.expect_error()
            return
        if kind == "hello":
            answer = self.client.receive()
            check(answer, "gateway")
            assert answer["type"] == "welcome"
            self.state = "between episodes"
        if kind == "parameters":
            answer = self.client.receive()
            check(answer, "gateway")
            assert answer == {"type": "parameters", "parameters": {}}
        if kind == "act":
            answer = self.client.receive()
            check(answer, "gateway")
            assert answer["type"] == "action"
        if kind in ("act", "end_episode"):
            self.state = "in an episode" if kind == "act" else "between episodes"

    def expect_error(self) -> None:
        answer = self.client.receive()
        check(answer, "gateway")
        assert (answer["type"], answer["code"]) == ("error", "out_of_turn")
        self.faults += 1
        if self.state == "new" or self.faults == 10:
            self.client.close()
            self.state = "closed"

    def teardown(self) -> None:
        self.client.close()


def test_messages_in_any_order(network: MemoryNetwork, learner: ScriptedLearner) -> None:
    running = RunningGateway(network)

    class Bound(AnyOrder):
        gateway = running

    try:
        run_state_machine_as_test(Bound, settings=settings(max_examples=20, stateful_step_count=30, deadline=None))
    finally:
        running.close()
    assert running.failure is None
