"""Test of deploy/systemd and the commands in docs/deploy.md."""

import configparser
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from certificates import make_certificates
from commands import check

from daedalus.launch.process_lifecycle import BAD_USAGE, NOT_REACHED, SUPERSEDED

ROOT = Path(__file__).parents[2]
SYSTEMD = ROOT / "deploy" / "systemd"
UNIT, ACTOR_UNIT = SYSTEMD / "daedalus@.service", SYSTEMD / "daedalus-actor@.service"


def commands(text: str) -> list[list[str]]:
    """Return the arguments of each `daedalus` command in a script or in the code blocks of a page."""
    lines = (
        re.sub(r"\s+#.*|\s*&$", "", line) for line in re.findall(r"(?<![`\w./-])daedalus (?=[a-z])([^\n`]*)", text)
    )
    return [shlex.split(line) for line in lines]


def unit(path: Path) -> configparser.ConfigParser:
    parsed = configparser.ConfigParser(interpolation=None, strict=False)  # some settings occur twice
    parsed.optionxform = str  # type: ignore[assignment] - as the documentation of configparser shows
    parsed.read_string(path.read_text())
    return parsed


@pytest.mark.parametrize(("path", "roles"), [(UNIT, ["learner", "exporter"]), (ACTOR_UNIT, ["actor", "actor"])])
def test_the_example_arguments_of_the_systemd_units_are_valid(path: Path, roles: list[str]) -> None:
    arguments = re.findall(r"^# +/etc/daedalus/\S+: +ARGUMENTS=(.*)$", path.read_text(), re.MULTILINE)
    assert [check(line.split()) for line in arguments] == roles


def test_the_systemd_units_restart_what_has_not_finished() -> None:
    service, actor = unit(UNIT)["Service"], unit(ACTOR_UNIT)["Service"]
    assert (service["Restart"], actor["Restart"]) == ("on-failure", "on-failure")
    assert service["SuccessExitStatus"] == str(NOT_REACHED)  # the budget was used up
    assert service["RestartPreventExitStatus"] == f"{BAD_USAGE} {SUPERSEDED}"
    assert actor["RestartPreventExitStatus"] == str(BAD_USAGE)
    assert actor["ExecStart"] == f"{service['ExecStart']} --stay"  # a drained actor, which ends with 0, stays away
    assert (actor["KillSignal"], actor["KillMode"]) == ("SIGUSR1", "mixed")  # to the actor alone, not its environments
    own = {"ExecStart", "RestartPreventExitStatus", "SuccessExitStatus", "TimeoutStopSec", "Environment"}
    own |= {"KillSignal", "KillMode"}
    assert {name: value for name, value in service.items() if name not in own} == {
        name: value for name, value in actor.items() if name not in own
    }


def test_the_tls_drop_in_passes_the_files_that_an_actor_needs(tmp_path: Path) -> None:
    text = (SYSTEMD / "tls.conf").read_text()
    command = f"{unit(ACTOR_UNIT)['Service']['ExecStart']} --tls %d"
    assert re.findall(r"^ExecStart=(.*)$", text, re.MULTILINE) == ["", command]  # empty: replaces that of the unit
    loaded = dict(re.findall(r"^LoadCredential=(.*):/etc/daedalus/tls/%i/(.*)$", text, re.MULTILINE))
    issued = make_certificates(tmp_path / "certs") / "actor-arm"
    assert loaded == {path.name: path.name for path in issued.iterdir()}


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
@pytest.mark.parametrize("path", [UNIT, ACTOR_UNIT])
def test_systemd_calls_the_exposure_of_the_units_ok(path: Path) -> None:
    # From 0, perfect, to 100; OK is below 50.
    words = ["systemd-analyze", "security", "--offline=true", "--threshold=20", str(path)]
    result = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert result.returncode == 0, result.stdout


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="systemd is not installed")
def test_the_user_of_the_units_is_created(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    words = ["systemd-sysusers", f"--root={tmp_path}", "--dry-run", str(SYSTEMD / "sysusers.conf")]
    result = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert f"Creating user '{unit(UNIT)['Service']['User']}'" in result.stdout


def test_the_commands_of_the_deployment_page_are_valid() -> None:
    page = (ROOT / "docs" / "deploy.md").read_text()
    blocks = "\n".join(re.findall(r"```\n(.*?)```", page, re.DOTALL))
    asked = [check(words) for words in commands(blocks)]
    assert {"exporter", "status"} <= set(asked)
