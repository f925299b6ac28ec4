"""Fixtures that several test files share."""

import gc
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import log_lines
import pytest
from _pytest.assertion import rewrite
from hypothesis import Phase, settings
from processes import Running, free_address, starting

if TYPE_CHECKING:
    from daedalus.transport.memory import MemoryNetwork

# The tensors of the tests are small. Further threads would spend most of their time waiting, on the cores of the other
# processes of the tests. A learner sets its own number of threads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Keep bytecode, also where the environment asks for none, as container images do: the tests start hundreds of
# processes, and each would spend a sixth of its time on compiling the same modules.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# No plugin of pydantic is installed. Each process would look for one in the metadata of all packages.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

gc.disable()  # until all tests are collected: what is imported is kept, and nothing of it need be looked at

# No test depends on the speed of the machine. For `make mutants` a failing example need not be made smaller.
settings.register_profile("daedalus", deadline=None, max_examples=35)  # `make fuzz` tries many more
settings.register_profile("mutants", deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
settings.load_profile("daedalus")

# Names in a module of tests that starts processes.
STARTING = {"subprocess", "Running", "starting", "processes_mentioning", "installed", "nbformat"}


def pytest_sessionstart(session: pytest.Session) -> None:
    """Rewrite the assertions of a part of the test files, whose bytecode all workers then load.

    All workers collect all files at the same time: on a new checkout each would rewrite all of them, which takes half
    of the time of the collection.
    """
    worker, count = os.environ.get("PYTEST_XDIST_WORKER", ""), int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0"))
    if worker.startswith("gw"):
        files = sorted((session.config.rootpath / "tests").rglob("test_*.py"))
        for file in files[int(worker[2:]) % count :: count]:
            folder = rewrite.get_cache_dir(file)
            bytecode = folder / (file.stem + rewrite.PYC_TAIL)
            if rewrite._read_pyc(file, bytecode) is None and rewrite.try_makedirs(folder):
                source, code = rewrite._rewrite_test(file, session.config)
                rewrite._write_pyc(session.config.stash[rewrite.assertstate_key], code, source, bytecode)


def pytest_collectstart() -> None:
    """Keep bytecode also after the import of a module that asks for none, as a game of PettingZoo does."""
    sys.dont_write_bytecode = False


def pytest_collection_finish() -> None:
    """Leave the modules and the collected tests out of garbage collections, each of which would look at all of them.

    There are fewer of the others, too, which took some hundredths of the time of the tests.
    """
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the files whose tests start processes, and the larger ones, so that at the end no worker works alone.

    In `make mutants`, where the first failure ends the tests of a mutant, begin with the fastest tests.
    """
    sizes = {path: path.stat().st_size for path in {item.path for item in items}}
    items.sort(key=lambda item: -sizes[item.path])
    items.sort(key=lambda item: not (isinstance(item, pytest.Function) and STARTING & vars(item.module).keys()))
    measured = config.rootpath / "mutmut-stats.json"
    if measured.exists():
        seconds = json.loads(measured.read_text("utf-8"))["duration_by_test"]
        items.sort(key=lambda item: seconds.get(item.nodeid, 0.0))


@pytest.fixture(autouse=True)
def _log_lines() -> Iterator[None]:
    with log_lines.collected():
        yield


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    """Function that starts `daedalus ARGUMENTS` in the folder of the test. Processes left are killed at the end."""
    with starting(tmp_path) as start_one:
        yield start_one


@pytest.fixture
def address() -> str:
    """Return a loopback address that no process listens on."""
    return free_address()


@pytest.fixture
def network() -> "MemoryNetwork":
    """Return the network that the test's transports share."""
    from daedalus.transport.memory import MemoryNetwork  # with numpy, for which the environment is set above

    return MemoryNetwork()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the test, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
