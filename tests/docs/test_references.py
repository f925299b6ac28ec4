"""The references of settings and commands, which are generated from the code."""

import re

import pytest
from pages import DOCS, hook
from pydantic import BaseModel

from daedalus.cli.command_table import COMMANDS
from daedalus.cli.main import USAGE
from daedalus.learner.reporting.metrics_rows import GROUPS
from daedalus.protocol.models import meanings
from daedalus.protocol.spec import RunSpec

SETTINGS = hook("settings_reference").settings_tables().splitlines()
REFERENCE = hook("command_reference")


def sections() -> dict[str, type[BaseModel]]:
    return {
        name: field.annotation
        for name, field in RunSpec.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
    }


FIELDS = [(section, key) for section, model in sections().items() for key in model.model_fields]


@pytest.mark.parametrize(("section", "key"), FIELDS)
def test_every_setting_has_a_meaning_and_a_row(section: str, key: str) -> None:
    assert re.fullmatch(r"[^a-z].*[.]", meanings(sections()[section])[key])
    rows = [row for row in SETTINGS if row.startswith(f"| `{section}.{key}` |")]
    assert len(rows) == 1
    assert rows[0].count("|") - rows[0].count("\\|") == 6


@pytest.mark.parametrize(
    ("setting", "kind", "limits", "default"),
    [
        ("training.learning_rate", "float", "> 0, ≤ 1", "`0.001`"),
        ("training.max_policy_lag", "int", "≥ 0", "unset"),
        ("environment.crop", "list of int", "4 values, each ≥ 0", "unset"),
        ("environment.action_table", "list of list of float", "2 to 65,536 values", "unset"),
        ("environment.id", "text", "1 to 200 characters", "required"),
        ("policy.hidden", "list of int", "each ≥ 1, at most 8 values", "`[64, 64]`"),
        ("policy.memory", "`none` `gru`", "", "`none`"),
        ("training.stop_when_solved", "bool", "", "`true`"),
    ],
)
def test_rows_state_type_range_and_default(setting: str, kind: str, limits: str, default: str) -> None:
    row = next(row for row in SETTINGS if row.startswith(f"| `{setting}` |"))
    assert [cell.strip() for cell in row.split("|")[2:5]] == [kind, limits, default]


def test_every_metric_is_in_the_reference_in_its_group() -> None:
    page = (DOCS / "reference" / "metrics.md").read_text("utf-8")
    for group, columns in GROUPS.items():
        section = page.partition(f"\n## `{group}`\n")[2].partition("\n## ")[0]
        cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
        assert re.findall(r"`(\w+)`", " ".join(cells)) == list(columns)


def test_every_command_is_in_the_reference() -> None:
    commands = re.findall(r"^  ([a-z]+) ", USAGE, re.MULTILINE)
    assert list(COMMANDS) == commands
    text = REFERENCE.command_sections()
    for command in [*commands, "certs init", "certs issue", "certs revoke"]:
        assert f" daedalus {command}\n\n```text\nusage: daedalus {command} " in text
