"""The arrows between the packages, and what nothing that is read may do."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("protocol", "policy", "actor", "learner", "launch", "bridge")
ALLOWED = {
    "protocol": {"protocol"},
    "policy": {"protocol", "policy"},
    "actor": {"protocol", "policy", "actor"},
    "learner": {"protocol", "policy", "learner"},
    "launch": {"protocol", "learner", "launch"},
    "bridge": {"protocol", "bridge"},
}
EXECUTING = {"pickle", "cloudpickle", "dill", "marshal", "shelve", "msgpack_numpy"}


def sources(package: str) -> list[tuple[Path, ast.Module]]:
    paths = sorted((ROOT / package).rglob("*.py"))
    assert paths
    return [(path, ast.parse(path.read_text())) for path in paths]


def imported(tree: ast.Module) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_along_the_arrows_only(package: str) -> None:
    for path, tree in sources(package):
        ours = {name.split(".")[0] for name in imported(tree)} & set(PACKAGES)
        assert ours <= ALLOWED[package], path


def test_zenoh_is_imported_in_one_file() -> None:
    users = {path.name for package in PACKAGES for path, tree in sources(package) if "zenoh" in imported(tree)}
    assert users == {"zenoh_transport.py"}


@pytest.mark.parametrize("package", PACKAGES)
def test_nothing_that_executes_what_it_reads_is_used(package: str) -> None:
    for path, tree in sources(package):
        assert not {name.split(".")[0] for name in imported(tree)} & EXECUTING, path
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                assert ast.unparse(node.func) not in {"eval", "exec", "torch.load", "yaml.load", "np.load"}, path


def test_nothing_is_decided_by_the_time_of_day() -> None:
    """Which may be set at any time; it only dates TensorBoard's events and certificates, and names run directories."""
    wall = {"time.time", "time.time_ns", "time.strftime", "datetime.now", "datetime.datetime.now"}
    users = {
        (path.name, ast.unparse(node.func))
        for package in PACKAGES
        for path, tree in sources(package)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) in wall
    }
    assert users == {
        ("metrics.py", "time.time"),
        ("run_directory.py", "time.strftime"),
        ("certificate_authority.py", "datetime.datetime.now"),  # certificates are good from one day to another
    }


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("actor.__main__", {"torch", "learner", "launch"}),
        ("actor.evaluate", {"torch", "learner", "launch", "zenoh"}),
        ("learner.__main__", {"torch", "actor", "launch", "gymnasium"}),
        ("launch.train", {"torch", "actor", "gymnasium", "zenoh", "onnxruntime"}),
        ("launch.router", {"torch", "actor", "gymnasium", "onnxruntime"}),
        ("launch.exporter", {"torch", "actor", "gymnasium", "onnxruntime", "prometheus_client"}),
        ("protocol.codec", {"torch", "zenoh", "policy"}),
        ("bridge.__main__", {"torch", "actor", "learner", "launch", "numpy", "gymnasium"}),
    ],
)
def test_a_process_loads_only_what_it_needs(module: str, absent: set[str]) -> None:
    program = f"import sys, {module}; print('\\n'.join(sys.modules))"
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert not absent & set(output.splitlines())
