"""Names and the wire format that the documentation shows are those of the code."""

import dataclasses
import importlib
import re
import sys
import typing
from pathlib import Path
from typing import get_origin

import pytest
from pages import DOCS, PAGES, ROOT, code_blocks, inline_code, name_of
from pydantic import BaseModel

from daedalus.protocol import messages
from daedalus.protocol.algorithms import ActorDemands
from daedalus.protocol.codec import PROTOCOL_VERSION
from daedalus.protocol.messages import ActorStatus, Event, EventKind, RunStatus
from daedalus.protocol.spec import ActorSpec, CollectionSpec, EnvironmentSpec, EvaluatorSpec, LearningSpec, RunSpec
from daedalus.transport.credentials import CERTIFICATE, CLIENTS, KEY

FOLDERS = (
    "actor|algorithms|benchmarks|cli|daedalus|deploy|docs|examples|gateway|learner|policy|protocol|tests|transport"
)
ZENOH_SETTINGS = ("transport/link/", "transport/unicast/")
FILE_ENDINGS = {"py", "ts", "md", "onnx", "toml", "json"}


def anchor(heading: str) -> str:
    """Return the anchor of a heading, as Markdown renderers make it."""
    return re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_files_and_settings_exist(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if not re.match(r"\w+:", link):
            check_link(page, link)
    for code in inline_code(page.read_text("utf-8")):
        for path in re.findall(rf"(?:^|\s)((?:{FOLDERS})/[\w./@-]*)", code):
            if "NAME" not in path and not path.startswith(ZENOH_SETTINGS):
                assert (ROOT / path).exists(), path
    check_settings(page)


def check_link(page: Path, link: str) -> None:
    path, _, part = link.partition("#")
    target = (page.parent / path) if path else page
    assert target.exists(), link
    if part and target.suffix == ".md":
        headings = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.MULTILINE)
        assert part in {anchor(heading) for heading in headings}, link


def check_settings(page: Path) -> None:
    text = page.read_text("utf-8")
    codes = [*inline_code(text), *code_blocks(text)]
    sections = "|".join(RunSpec.model_fields)
    for section, key in re.findall(rf"(?<![\w./:-])({sections})\.([a-z_]+)", "\n".join(codes)):
        model = RunSpec.model_fields[section].annotation
        if get_origin(model) is dict:  # of sections by any name
            continue
        assert isinstance(model, type)
        assert issubclass(model, BaseModel)
        assert key in model.model_fields or key in FILE_ENDINGS, f"{section}.{key}"


def test_the_messages_about_certificates_are_those_of_the_code() -> None:
    table = (DOCS / "security.md").read_text("utf-8").partition("| message |")[2].partition("\n\n")[0]
    sources = "".join(path.read_text("utf-8") for path in (ROOT / "transport").glob("*.py"))
    sources = sources.replace("{KEY}", KEY).replace("{CERTIFICATE}", CERTIFICATE)
    sources = sources.replace("{CLIENTS}", CLIENTS)
    messages = re.findall(r"^\| `([^`]+)` \|", table, re.MULTILINE)
    assert len(messages) > 4
    for message in messages:
        for words in filter(None, (part.strip() for part in message.split("..."))):
            assert words in sources, message


def test_the_files_to_open_have_what_is_named_in_them() -> None:
    """The tables of docs/architecture.md name a function or class of a file as `path` (`name`)."""
    named = re.findall(r"`([\w/]+\.py)` \(`([\w.]+)`\)", (DOCS / "architecture.md").read_text("utf-8"))
    assert len(named) > 5
    for path, name in named:
        pattern = rf"^\s*(class|def) {name.rpartition('.')[2]}\b|^{name} = "
        assert re.search(pattern, (ROOT / path).read_text("utf-8"), re.MULTILINE), f"{path} {name}"


def test_the_way_of_a_rollout_is_the_one_that_is_traced(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """See docs/trace_rollout.py, which names what is missing and what is superfluous."""
    monkeypatch.syspath_prepend(str(DOCS))
    monkeypatch.setattr(sys, "argv", ["trace_rollout.py", "--check"])
    status = importlib.import_module("trace_rollout").main()
    assert status == 0, capsys.readouterr()


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
