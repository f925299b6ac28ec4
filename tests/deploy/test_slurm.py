"""Test of deploy/slurm: its commands, and how the job ends, with programs in place of daedalus and srun."""

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import check
from processes import LIMIT, until

from daedalus.cli.commands.certs import parser as certs_parser

SCRIPT = Path(__file__).parents[2] / "deploy" / "slurm" / "daedalus.sbatch"

# It notes its arguments and the mode of the certificates' folder; the files decide when router and learner end.
DAEDALUS = """\
#!/bin/bash
echo "$*" >> calls
case $1 in
certs) stat -c %a .daedalus-* >> modes ;;
router) until [ -e end-router ]; do sleep 0.05; done; exit 1 ;;
actor) until [ -e end-actors ]; do sleep 0.05; done; exit 1 ;;
learner)
    trap 'echo TERM >> signals; exit 0' TERM
    touch learner-runs
    until [ -e end-learner ]; do sleep 0.05; done
    exit 3 ;;
esac
"""


@pytest.fixture
def job(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    programs = tmp_path / "bin"
    programs.mkdir()
    sleep = f"#!/bin/bash\nexec {shutil.which('sleep')} 0.05\n"  # a minute of the script takes 3 s
    for name, text in (("daedalus", DAEDALUS), ("srun", '#!/bin/bash\nshift\nexec "$@"\n'), ("sleep", sleep)):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}", "SLURM_JOB_ID": "12345"}
    with open(tmp_path / "errors", "wb") as errors:
        running = subprocess.Popen(
            ["bash", str(SCRIPT)], cwd=tmp_path, env=environment, stderr=errors, start_new_session=True
        )
    until((tmp_path / "learner-runs").exists)
    yield running
    with contextlib.suppress(ProcessLookupError):
        os.killpg(running.pid, signal.SIGKILL)
    running.wait(LIMIT)


def test_the_commands_of_the_slurm_script_are_valid() -> None:
    text = SCRIPT.read_text()
    assert "--insecure" not in text
    assert "tcp/" not in text
    text = text.replace("$address", "tls/node:7447").replace("${address##*:}", "7447").replace("$tls", "certs")
    lines = re.findall(r"(?<![`\w./-])daedalus (?=[a-z])([^\n`]*)", re.sub(r"^#.*", "", text, flags=re.MULTILINE))
    commands = [shlex.split(re.sub(r"\s*&$", "", line.replace("$host", "node"))) for line in lines]
    for words in commands[:2]:
        assert certs_parser().parse_args(words[1:])
    assert [check(words) for words in commands[2:]] == ["router", "actor", "actor", "learner"]


def test_certificates_are_in_a_private_folder_that_is_removed(job: subprocess.Popen[bytes], tmp_path: Path) -> None:
    assert set((tmp_path / "modes").read_text().split()) == {"700"}
    (folder,) = tmp_path.glob(".daedalus-*")

    def used() -> list[str]:
        return [line for line in (tmp_path / "calls").read_text().splitlines() if not line.startswith("certs")]

    until(lambda: len(used()) == 4)  # the learner may be the first of them to run
    evaluator = "/actor-node --name node.evaluator --evaluator"
    assert sorted(line.rpartition(str(folder))[2] for line in used()) == [
        "/actor-node",
        evaluator,
        "/learner",
        "/router",
    ]
    (tmp_path / "end-learner").touch()
    job.wait(LIMIT)
    assert not folder.exists()


def test_the_job_ends_with_the_status_of_the_learner(job: subprocess.Popen[bytes], tmp_path: Path) -> None:
    (tmp_path / "end-learner").touch()
    assert job.wait(LIMIT) == 3


def test_the_signal_before_the_end_of_the_job_reaches_the_learner(job: subprocess.Popen[bytes], tmp_path: Path) -> None:
    job.send_signal(signal.SIGTERM)
    assert job.wait(LIMIT) == 0
    assert (tmp_path / "signals").read_text() == "TERM\n"


def test_the_job_fails_if_the_router_fails(job: subprocess.Popen[bytes], tmp_path: Path) -> None:
    (tmp_path / "end-router").touch()
    assert job.wait(LIMIT) == 1
    assert (tmp_path / "errors").read_text() == "the router failed: the job ends\n"
    assert (tmp_path / "signals").read_text() == "TERM\n"


def test_the_job_ends_if_all_actors_have_failed(job: subprocess.Popen[bytes], tmp_path: Path) -> None:
    """The learner would wait for an actor until the time of the job is over."""
    (tmp_path / "end-actors").touch()
    assert job.wait(LIMIT) == 1
    assert (tmp_path / "errors").read_text() == "all actors have ended: the job ends\n"
    assert (tmp_path / "signals").read_text() == "TERM\n"


def test_actors_that_leave_a_run_that_is_over_do_not_fail_the_job(job: subprocess.Popen[bytes], tmp_path: Path) -> None:
    (tmp_path / "end-actors").touch()
    until(lambda: "actor" in (tmp_path / "calls").read_text())
    (tmp_path / "end-learner").touch()
    assert job.wait(LIMIT) == 3
