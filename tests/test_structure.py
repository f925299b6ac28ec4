"""Test of the structure: which package imports which, and that no code executes what it reads."""

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("protocol", "transport", "policy", "algorithms", "actor", "learner", "gateway", "launch", "analysis", "cli")
ALLOWED = {
    "protocol": {"protocol"},
    "transport": {"protocol", "transport"},
    "policy": {"protocol", "policy"},
    "algorithms": {"protocol", "policy", "algorithms"},
    "actor": {"protocol", "transport", "policy", "algorithms", "actor"},
    "learner": {"protocol", "transport", "policy", "algorithms", "learner"},
    "gateway": {"protocol", "transport", "policy", "actor", "gateway"},
    "launch": {*PACKAGES} - {"analysis", "cli"},
    "analysis": {*PACKAGES} - {"cli"},
    "cli": {*PACKAGES},
}
EXECUTING = {"pickle", "cloudpickle", "dill", "marshal", "shelve", "msgpack_numpy"}

EXECUTING_FUNCTIONS = {
    *("eval", "exec", "compile", "__import__", "builtins.eval", "builtins.exec", "os.system", "os.popen"),
    *("torch.load", "torch.jit.load", "torch.hub.load", "torch.serialization.load", "yaml.load", "numpy.load"),
    *("runpy.run_path", "runpy.run_module", "pandas.read_pickle", "joblib.load"),
}


@functools.cache
def sources(package: str) -> list[tuple[Path, ast.Module]]:
    paths = sorted((ROOT / package).rglob("*.py"))
    assert paths
    return [(path, ast.parse(path.read_text())) for path in paths]


@functools.cache
def imported(tree: ast.Module) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def dotted(node: ast.expr) -> str:
    """Return a name such as `os.path.join`, or an empty string for another expression."""
    names = []
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(names)]) if isinstance(node, ast.Name) else ""


@functools.cache
def called(tree: ast.Module) -> set[str]:
    """Return the whole names of the functions that are called, whatever name they were imported by."""
    whole: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            whole |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            first, dot, rest = dotted(node.func).partition(".")
            found.add(whole.get(first, first) + dot + rest)
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_only_the_allowed_packages(package: str) -> None:
    for path, tree in sources(package):
        ours = {name.split(".")[1] for name in imported(tree) if name.startswith("daedalus.")}
        assert ours & {*PACKAGES} <= ALLOWED[package], path


def test_collecting_rollouts_needs_no_session() -> None:
    """The session uses the collectors; an import in the other direction would make the two packages one."""
    for path, tree in sources("actor/collecting"):
        assert not [name for name in imported(tree) if name.startswith("daedalus.actor.session")], path


def test_no_file_imports_a_package_by_its_folder() -> None:
    """A package that is imported by the name of its folder would exist twice, and other packages may have that name."""
    suspect = re.compile(rf"\b(?:import|from)\b.*(?<![.\w])(?:{'|'.join(PACKAGES)})\b")  # few files need to be parsed
    for folder in (*PACKAGES, "tests", "benchmarks", "examples"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            text = path.read_text()
            if any(suspect.search(line) for line in text.splitlines() if "import" in line or "from" in line):
                top_level = {name.split(".")[0] for name in imported(ast.parse(text))}
                assert not top_level & {*PACKAGES}, path


def test_only_the_zenoh_files_of_the_transport_import_zenoh() -> None:
    users = {path for package in PACKAGES for path, tree in sources(package) if "zenoh" in imported(tree)}
    assert users
    assert all(path.name.startswith("zenoh_") and path.parent.name == "transport" for path in users)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_file_uses_a_function_that_executes_its_input(package: str) -> None:
    for path, tree in sources(package):
        assert not {name.split(".")[0] for name in imported(tree)} & EXECUTING, path
        assert not called(tree) & EXECUTING_FUNCTIONS, path


DATING = {
    *("tensorboard_writer.py", "known_trackers.py", "logs.py", "events.py", "run_directory.py"),
    *("certificates.py", "certificate_expiry.py", "security.py"),  # valid until a date
}


def test_no_decision_depends_on_the_system_clock() -> None:
    """The system clock may change at any time. It dates events, records and certificates, and names directories."""
    wall = {"time.time", "time.time_ns", "time.strftime", "datetime.now", "datetime.datetime.now"}
    users = {path.name for package in PACKAGES for path, tree in sources(package) if called(tree) & wall}
    assert users <= DATING


# What a process has not loaded after the modules that it needs, in two processes: one that imports a row has imported
# the rows above it, too, whose processes load none of what is absent in it.
NEEDED = {
    "with the learner": [
        (["cli.main"], {"numpy", "pydantic"}),  # the command may be a process of its own
        (
            ["cli.commands.train", "launch.train_function"],
            {"torch", "daedalus.actor", "gymnasium", "zenoh", "onnxruntime", "shtab", "prometheus_client"},
        ),
        (
            ["cli.commands.router", "cli.commands.exporter"],
            {"torch", "daedalus.actor", "gymnasium", "onnxruntime", "prometheus_client"},
        ),
        (["cli.commands.learner"], {"torch", "daedalus.actor", "gymnasium"}),
    ],
    "with the actor": [
        (["protocol.codec"], {"torch", "zenoh", "daedalus.policy", "daedalus.transport"}),
        (
            ["actor.evaluation.loaded_policy", "launch.evaluation", "cli.commands.evaluate"],
            {"torch", "daedalus.learner", "daedalus.algorithms", "zenoh"},
        ),
        (
            ["gateway.client_gateway", "gateway.server", "cli.commands.actor"],
            {"torch", "daedalus.learner", "daedalus.algorithms"},
        ),
    ],
}


@pytest.mark.parametrize("rows", NEEDED.values(), ids=NEEDED)
def test_a_process_loads_only_what_it_needs(rows: list[tuple[list[str], set[str]]]) -> None:
    program = "import sys\n" + "".join(
        f"import {', '.join(f'daedalus.{module}' for module in modules)}; print(*sys.modules)\n" for modules, _ in rows
    )
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    for (modules, absent), loaded in zip(rows, output.splitlines(), strict=True):
        assert not absent & set(loaded.split()), modules
