"""Test of wheel and sdist: their files, and use beside packages and scripts of the same names."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from installing import build, installed, run

import daedalus
from daedalus.learner.run.settings import preset_names

ROOT = Path(__file__).parent.parent
FILES = ("LICENSE", "MANIFEST.in", "README.md", "pyproject.toml")
SCRIPTS = ("actor", "cli", "gateway", "launch", "learner", "policy", "protocol", "transport")
RAISES = "raise ImportError('this is not the package that Daedalus means')\n"


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy the source tree with its links, because a build leaves files in it."""
    copy = tmp_path_factory.mktemp("source") / "tree"
    shutil.copytree(ROOT / "daedalus", copy / "daedalus", symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for link in (copy / "daedalus").iterdir():
        if link.is_symlink():
            shutil.copytree(ROOT / link.name, copy / link.name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(ROOT / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def sdist(tree: Path) -> Path:
    return build("sdist", tree, tree.parent / "sdist")


@pytest.fixture(scope="module")
def wheel(sdist: Path) -> Path:
    """Build the wheel from the unpacked sdist, as an installer does if there is no wheel."""
    unpacked = sdist.parent.parent / "unpacked"
    with tarfile.open(sdist) as archive:
        archive.extractall(unpacked, filter="data")
    (folder,) = unpacked.iterdir()
    return build("wheel", folder, sdist.parent.parent / "wheel")


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create an environment with the wheel and with a package `launch`, as ROS 2 installs it."""
    folder = tmp_path_factory.mktemp("installed") / "environment"
    packages = installed(folder, wheel)
    (packages / "launch").mkdir()
    (packages / "launch" / "__init__.py").write_text(RAISES)
    (packages / "matplotlib.py").write_text("raise ModuleNotFoundError\n")  # no report, which takes a second
    return folder / "bin"


@pytest.fixture
def scripts(tmp_path: Path) -> Path:
    """Return a folder with user scripts that have the names of our packages."""
    for name in SCRIPTS:
        (tmp_path / f"{name}.py").write_text(RAISES)
    return tmp_path


@pytest.fixture
def uv(wheel: Path, tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run uv without network: of the packages, it installs the wheel alone, and this environment has the rest."""
    requirements = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = [re.split(r"[^\w-]", each)[0] for each in requirements]
    (tmp_path / "left_out.txt").write_text("".join(f"{name} ; sys_platform == 'none'\n" for name in names))
    beside = tmp_path / "beside"
    beside.mkdir()
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if not entry.name.startswith(("torch", "daedalus", "__editable__", "sitecustomize")):
            (beside / entry.name).symlink_to(entry)
    folders = {"UV_TOOL_DIR": "tools", "UV_TOOL_BIN_DIR": "bin", "UV_CACHE_DIR": "cache"}
    environment = os.environ | {name: str(tmp_path / folder) for name, folder in folders.items()}
    environment |= {"PYTHONPATH": str(beside), "UV_PYTHON": sys.executable, "UV_OFFLINE": "1", "UV_NO_CONFIG": "1"}
    options = ("--no-index", "--find-links", str(wheel.parent), "--overrides", str(tmp_path / "left_out.txt"))
    program = Path(sysconfig.get_path("scripts")) / "uv"

    def run_uv(*words: str) -> subprocess.CompletedProcess[str]:
        command = [program, *words[:2], *options, *words[2:]]
        return subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)

    return run_uv


def expected_in_package() -> set[str]:
    """Return the paths of all files of the package, through its links."""
    paths = set()
    for entry in (ROOT / "daedalus").iterdir():
        files = [path for path in entry.resolve().rglob("*") if path.is_file()] if entry.is_dir() else [entry]
        paths |= {path.relative_to(ROOT) for path in files if "__pycache__" not in path.parts}
    return {path.as_posix() if path.parts[0] == "daedalus" else f"daedalus/{path.as_posix()}" for path in paths}


def test_the_wheel_holds_one_complete_top_level_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    ours = {name for name in names if name.startswith("daedalus/")}
    assert ours == expected_in_package()
    others = {name.split("/")[0] for name in names - ours}
    assert len(others) == 1
    assert others.pop().endswith(".dist-info")
    assert {"daedalus/py.typed", "daedalus/policy/pretrained/car_racing/program.onnx"} < ours
    assert {f"daedalus/learner/run/presets/{name}.toml" for name in preset_names()} < ours
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_the_sdist_holds_the_same_package_and_its_build_files(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        files = [member for member in archive.getmembers() if not member.isdir()]
    assert all(member.isfile() for member in files)  # no links: not every system supports them
    names = {member.name.partition("/")[2] for member in files}
    ours = {name for name in names if name.startswith("daedalus/")}
    assert ours == expected_in_package()
    made = {name for name in names - ours if name.startswith("daedalus_rl.egg-info/")}
    assert names - ours - made == {*FILES, "PKG-INFO", "setup.cfg"}


def test_train_works_beside_packages_and_scripts_of_the_same_names(environment: Path, scripts: Path) -> None:
    settings = ("--env-steps", "500", "--set", "training.target_return=none", "--set", "evaluation.final_episodes=1")
    name = "r\u00e9 \u202e$x"  # of a directory
    output = run(
        environment / "daedalus", "train", "cartpole", "--actors", "1", *settings, "--run-dir", name, folder=scripts
    )
    assert "evaluation: return" in output
    assert "for a report with the curves: pip install" in output


def test_uvx_runs_the_distribution_by_its_name(uv: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    ran = uv("tool", "run", "daedalus-rl", "--version")
    assert (ran.returncode, ran.stdout) == (0, f"daedalus {daedalus.__version__}\n"), ran.stderr


def test_a_tool_without_torch_is_an_actor_and_says_how_to_install_a_learner(
    uv: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    installed_tool = uv("tool", "install", "daedalus-rl")
    assert installed_tool.returncode == 0, installed_tool.stderr
    assert {path.stem for path in (tmp_path / "bin").iterdir()} == {"daedalus", "daedalus-rl"}
    checked = uv("tool", "run", "daedalus-rl", "check", "--env", "CartPole-v1", "--seconds", "0.1")
    assert checked.returncode == 0, checked.stdout
    for command in (("train", "cartpole"), ("learner", "cartpole")):
        refused = uv("tool", "run", "daedalus-rl", *command)
        assert refused.returncode == 2, refused.stderr
        assert re.fullmatch(
            rf'daedalus {command[0]}: .* a learner needs torch: pip install "daedalus-rl\[learner\]"; .*\n',
            refused.stderr,
        )


def test_the_public_api_works_beside_packages_and_scripts_of_the_same_names(environment: Path, scripts: Path) -> None:
    program = (
        "import daedalus, gymnasium\n"
        "policy = daedalus.load_policy(pretrained='car_racing')\n"
        "for name in daedalus.__all__: getattr(daedalus, name)\n"
        "print(daedalus.__file__, daedalus.__version__)\n"
    )
    where, version = run(environment / "python", "-c", program, folder=scripts).split()
    assert Path(where).is_relative_to(environment.parent)
    assert version in (ROOT / "pyproject.toml").read_text()


def test_a_module_added_to_the_source_is_importable_at_once_if_the_install_is_editable(
    tree: Path, tmp_path: Path
) -> None:
    shutil.copytree(tree, tmp_path / "tree", symlinks=True)
    installed(tmp_path / "environment", "--editable", tmp_path / "tree")
    (tmp_path / "tree" / "policy" / "added_module.py").write_text("ANSWER = 42\n")
    program = "from daedalus.policy.added_module import ANSWER; print(ANSWER)"
    assert run(tmp_path / "environment" / "bin" / "python", "-c", program, folder=tmp_path) == "42\n"
