"""The references of settings, commands and the Python API, whose generated parts are in the repository."""

import functools
import importlib
import re
import sys

import pytest
from pages import DOCS

from daedalus.cli.command_table import COMMANDS, USAGE
from daedalus.cli.commands.settings_command import Setting, all_settings
from daedalus.learner.reporting.metrics_rows import GROUPS


@functools.cache
def settings() -> dict[str, Setting]:
    """Return all settings by path. Their meanings are read from the sources, which takes a tenth of a second."""
    return {setting.path: setting for setting in all_settings()}


def test_the_generated_parts_of_the_references_are_those_of_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS))
    monkeypatch.setattr(sys, "argv", ["generate_reference.py", "--check"])
    importlib.import_module("generate_reference").main()  # exits, after it has named the pages that differ


def test_every_setting_has_a_meaning() -> None:
    for setting in settings().values():
        assert re.fullmatch(r"[^a-z].*[.]", setting.meaning), setting.path


@pytest.mark.parametrize(
    ("name", "kind", "limits", "default"),
    [
        ("training.learning_rate", "float", "> 0, ≤ 1", "`0.001`"),
        ("training.max_policy_lag", "int", "≥ 0", "unset"),
        ("environment.crop", "list of int", "4 values, each ≥ 0", "unset"),
        ("environment.action_table", "list of list of float", "2 to 65,536 values", "unset"),
        ("environment.id", "text", "1 to 200 characters", "required"),
        ("league.sides", "list of list of text", "each at most 64 characters, at most 1,024 values", "`[]`"),
        ("policy.hidden", "list of int", "each ≥ 1, at most 8 values", "`[64, 64]`"),
        ("policy.memory", "`none` `gru`", "", "`none`"),
        ("training.stop_when_solved", "bool", "", "`true`"),
    ],
)
def test_settings_state_type_range_and_default(name: str, kind: str, limits: str, default: str) -> None:
    setting = settings()[name]
    assert (setting.kind, setting.limits, setting.default) == (kind, limits, default)


def test_every_metric_is_in_the_reference_in_its_group() -> None:
    page = (DOCS / "reference" / "metrics.md").read_text("utf-8")
    for group, columns in GROUPS.items():
        section = page.partition(f"\n## `{group}`\n")[2].partition("\n## ")[0]
        cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
        assert re.findall(r"`(\w+)`", " ".join(cells)) == list(columns)


def test_every_command_is_in_the_reference() -> None:
    commands = re.findall(r"^  ([a-z]+) ", USAGE, re.MULTILINE)
    assert list(COMMANDS) == commands
    page = (DOCS / "reference" / "commands.md").read_text("utf-8")
    for command in [*commands, "certs init", "certs issue", "certs revoke"]:
        assert f"# daedalus {command}\n" in page
