"""The clients of examples/gateway: each plays, and a learner trains on its rollouts."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import node
import pytest
from processes import ENDLESS, Running, starting, until

from daedalus.transport.connecting import connect
from daedalus.transport.status_query import ask

FOLDER = Path(__file__).parents[2] / "examples" / "gateway"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """A learner and a gateway; return the address of the learner and the port of the gateway."""
    folder = tmp_path_factory.mktemp("run")
    address = f"unixsock-stream/{folder}/learner"
    folder.chmod(0o700)
    with starting(folder) as start:
        learner = start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS)
        gateway = start("gateway", "--connect", address, "--listen", "127.0.0.1:0")
        gateway.expect("follows run")  # the learner answers
        yield address, gateway.expect(r"ws://127\.0\.0\.1:(\d+)/actor").group(1)
        for process in (gateway, learner):
            process.process.terminate()
            assert process.wait() == 0, process.output


def command(program: str, port: str, name: str, folder: Path) -> list[str]:
    """Return the command line of a client; build it first if it must be built."""
    address = f"ws://127.0.0.1:{port}/actor"
    if program == "client.js":
        return [node.executable((22, 0), "WebSockets"), str(FOLDER / program), address, name]
    if program == "client.ts":
        return [node.executable((22, 18), "TypeScript"), str(FOLDER / program), address, name]
    if program == "client.py":
        return [sys.executable, str(FOLDER / program), address, name]
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler is installed")
    built = folder / "client"
    subprocess.run([compiler, "-Wall", "-Wextra", "-Werror", "-o", built, FOLDER / program, "-lm"], check=True)
    return [str(built), port, name]


@pytest.mark.parametrize("program", ["client.py", "client.js", "client.ts", "client.c"])
def test_learner_trains_on_what_a_client_plays(run: tuple[str, str], tmp_path: Path, program: str) -> None:
    address, port = run
    name = program.replace(".", "-")
    client = Running(command(program, port, name, tmp_path), tmp_path)
    transport = connect([address])
    try:
        client.expect("joined .*run")
        client.expect(r"return \d+")

        def trained() -> int:
            return sum(actor.env_steps for status in ask(transport) for actor in status.actors if actor.actor == name)

        until(lambda: trained() > 100)
        (rejected,) = [actor.rollouts_rejected for actor in ask(transport)[0].actors if actor.actor == name]
        assert not rejected.keys() - {"stale"}
    finally:
        transport.close()
        client.end()


@pytest.mark.parametrize(
    ("program", "lines"), [("client.py", 60), ("client.js", 60), ("client.c", 60), ("client.ts", 100)]
)
def test_client_is_short(program: str, lines: int) -> None:
    assert len((FOLDER / program).read_text().splitlines()) <= lines


def test_types_of_the_typescript_client_are_those_of_the_messages(tmp_path: Path) -> None:
    compiler = FOLDER / "node_modules" / "typescript" / "bin" / "tsc"
    if not compiler.is_file():
        pytest.skip("the packages of examples/gateway are not installed: run `make examples`")
    for name in ("tsconfig.json", "package.json"):
        shutil.copy(FOLDER / name, tmp_path)
    right = (FOLDER / "client.ts").read_text()
    (tmp_path / "client.ts").write_text(right)
    mistakes = {
        '{ type: "act", observation, reward }': '{ type: "act", observations: observation, reward }',
        "terminated: fallen, observation: state, reward: 1": "terminated: fallen, reward: 1",
        "await actor.act(state,": "await actor.act([1],",
    }
    for number, (before, after) in enumerate(mistakes.items()):
        assert before in right
        (tmp_path / f"mistake{number}.ts").write_text(right.replace(before, after))
    (tmp_path / "node_modules").symlink_to(FOLDER / "node_modules")
    command = [node.executable((22, 18), "TypeScript"), str(compiler), "-p", str(tmp_path)]
    checked = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert {*re.findall(r"(\w+\.ts)\(", checked.stdout)} == {f"mistake{number}.ts" for number in range(3)}, (
        checked.stdout
    )
