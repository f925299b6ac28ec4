"""Test of deploy/systemd and the commands in docs/deploy.md."""

import configparser
import re
import shlex
from pathlib import Path

from commands import check

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "deploy" / "systemd" / "daedalus@.service"


def commands(text: str) -> list[list[str]]:
    """Return the arguments of each `daedalus` command in a script or in the code blocks of a page."""
    lines = (
        re.sub(r"\s+#.*|\s*&$", "", line) for line in re.findall(r"(?<![`\w./-])daedalus (?=[a-z])([^\n`]*)", text)
    )
    return [shlex.split(line) for line in lines]


def test_the_example_arguments_of_the_systemd_unit_are_valid() -> None:
    arguments = re.findall(r"^# +/etc/daedalus/\S+: +ARGUMENTS=(.*)$", UNIT.read_text(), re.MULTILINE)
    assert [check(line.split()) for line in arguments] == ["learner", "actor"]


def test_the_systemd_unit_accepts_the_exit_status_of_a_used_up_budget() -> None:
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment] - as the documentation of configparser shows
    unit.read_string(UNIT.read_text())
    assert unit["Service"]["ExecStart"] == "/opt/daedalus/bin/daedalus $ARGUMENTS"
    assert unit["Service"]["SuccessExitStatus"] == "3"
    assert unit["Service"]["Restart"] == "on-failure"


def test_the_commands_of_the_deployment_page_are_valid() -> None:
    page = (ROOT / "docs" / "deploy.md").read_text()
    blocks = "\n".join(re.findall(r"```\n(.*?)```", page, re.DOTALL))
    asked = [check(words) for words in commands(blocks)]
    assert {"exporter", "status"} <= set(asked)
