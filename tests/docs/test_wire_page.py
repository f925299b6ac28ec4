"""docs/wire.md against the messages and the specification of the code."""

import dataclasses
import re
import typing

import pytest
from pages import DOCS

from daedalus.protocol import messages
from daedalus.protocol.algorithms import ActorDemands
from daedalus.protocol.codec import PROTOCOL_VERSION
from daedalus.protocol.messages import ActorStatus, Event, EventKind, RunStatus
from daedalus.protocol.spec import ActorSpec, CollectionSpec, EnvironmentSpec, EvaluatorSpec, LearningSpec

WIRE = (DOCS / "wire.md").read_text("utf-8")
TABLES = ["Join", "Welcome", "Refusal", "Program", "Snapshot", "Rollout", "Gradient", "Acknowledgement"]
TABLES += ["RunEnded", "SnapshotRequest", "SnapshotPart", "CompactSnapshot", "EvaluationReport", "ClientReport"]


def first_column(table: str) -> set[str]:
    """Return the names in the first column of a table's rows, `weights/NAME` as `weights`."""
    rows = re.findall(r"^\|((?: `[\w/]+`,?)+) \|", table, re.MULTILINE)
    return {name.split("/")[0] for row in rows for name in re.findall(r"`([\w/]+)`", row)}


def table_after(start: str) -> str:
    """Return the first table that follows a text."""
    _, found, rest = WIRE.partition(start)
    assert found, start
    table = re.search(r"^\|.*?(?=\n\n|\Z)", rest, re.DOTALL | re.MULTILINE)
    assert table
    return table[0]


def table_under(head: str) -> str:
    """Return the rows of the table whose head begins so."""
    _, found, rest = WIRE.partition(f"\n{head}")
    assert found, head
    return rest.partition("\n\n")[0]


@pytest.mark.parametrize("message", TABLES)
def test_a_messages_table_has_its_fields(message: str) -> None:
    fields = {field.name for field in dataclasses.fields(getattr(messages, message))}
    assert first_column(table_after(f"**{message}**")) == fields


def test_every_message_is_on_the_page() -> None:
    for message in typing.get_args(messages.Message):
        assert f"{message.__name__}" in WIRE


@pytest.mark.parametrize(("message", "field"), [("Refusal", "code"), ("Acknowledgement", "verdict")])
def test_codes_and_verdicts_are_all_explained(message: str, field: str) -> None:
    words = typing.get_args(typing.get_type_hints(getattr(messages, message))[field])
    table = table_under("| code |") if field == "code" else table_after("### Verdicts")
    assert first_column(table) == set(words)


def test_the_status_tables_have_its_fields() -> None:
    assert first_column(table_under("| of the run |")) == set(RunStatus.model_fields)
    assert first_column(table_under("| of each actor |")) == set(ActorStatus.model_fields)
    assert first_column(table_under("| of each event |")) == set(Event.model_fields)
    kinds = table_under("| of each event |").partition("| `kind` |")[2].partition("\n")[0]
    assert tuple(re.findall(r"`(\w+)`", kinds)) == typing.get_args(EventKind)


def test_the_specifications_tables_have_what_an_actor_needs() -> None:
    environment = first_column(table_under("| `environment.` |")) | {"backend", "processes"}  # named in the row of `id`
    assert environment == set(EnvironmentSpec.model_fields)
    assert first_column(table_under("| `collection.` |")) == set(CollectionSpec.model_fields) - {"actors"}
    spec = table_under("| `spec.` |")
    assert first_column(spec) == set(ActorSpec.model_fields)
    for name, part in (("evaluation", EvaluatorSpec), ("algorithm", ActorDemands), ("learning", LearningSpec)):
        row = spec.partition(f"| `{name}` |")[2].partition("\n")[0]
        assert set(part.model_fields) <= set(re.findall(r"`(\w+)`", row))


def test_the_page_is_for_this_version() -> None:
    assert f"protocol version **{PROTOCOL_VERSION}**" in WIRE
    assert f"`tests/protocol/golden/v{PROTOCOL_VERSION}/`" in WIRE
