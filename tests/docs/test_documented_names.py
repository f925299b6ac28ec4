"""Links, files, settings and functions that the documentation names exist."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from pages import DOCS, PAGES, ROOT, code_blocks, inline_code, name_of
from pydantic import BaseModel

from daedalus.protocol.spec import RunSpec
from daedalus.transport.credentials import CERTIFICATE, CLIENTS, KEY

FOLDERS = (
    "actor|algorithms|benchmarks|cli|daedalus|deploy|docs|examples|gateway|learner|policy|protocol|tests|transport"
)
ZENOH_SETTINGS = ("transport/link/", "transport/unicast/")
FILE_ENDINGS = {"py", "ts", "md", "toml", "json"}


def anchor(heading: str) -> str:
    """Return the anchor of a heading, as Markdown renderers make it."""
    return re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if re.match(r"\w+:", link):
            continue
        path, _, part = link.partition("#")
        target = (page.parent / path) if path else page
        assert target.exists(), link
        if part and target.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.MULTILINE)
            assert part in {anchor(heading) for heading in headings}, link


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_exist(page: Path) -> None:
    for code in inline_code(page.read_text("utf-8")):
        for path in re.findall(rf"(?:^|\s)((?:{FOLDERS})/[\w./@-]*)", code):
            if "NAME" not in path and not path.startswith(ZENOH_SETTINGS):
                assert (ROOT / path).exists(), path


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_settings_exist(page: Path) -> None:
    text = page.read_text("utf-8")
    codes = [*inline_code(text), *code_blocks(text)]
    sections = "|".join(RunSpec.model_fields)
    for section, key in re.findall(rf"(?<![\w./:-])({sections})\.([a-z_]+)", "\n".join(codes)):
        model = RunSpec.model_fields[section].annotation
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


def test_the_way_of_a_rollout_is_the_one_that_is_traced() -> None:
    """See docs/trace_rollout.py, which names what is missing and what is superfluous."""
    command = [sys.executable, str(DOCS / "trace_rollout.py"), "--check"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
