"""Test of what a process may use of its machine."""

import os
import sys
from pathlib import Path

import pytest

from daedalus.transport import process_usage
from daedalus.transport.process_usage import available_memory, available_processors


@pytest.fixture
def container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a container's limits. The machine has 64 processors."""
    monkeypatch.setattr(process_usage, "CONTROL_GROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {*range(64)}, raising=False)
    return tmp_path


@pytest.mark.parametrize(
    ("limit", "processors"),
    [("200000 100000", 2), ("150000 100000", 2), ("20000 100000", 1), ("max 100000", 64), ("", 64), (None, 64)],
)
def test_processors_are_those_of_the_container(container: Path, limit: str | None, processors: int) -> None:
    if limit is not None:
        (container / "cpu.max").write_text(f"{limit}\n")
    assert available_processors() == processors


@pytest.mark.skipif(sys.platform != "linux", reason="no /proc/meminfo")
def test_memory_is_that_of_the_container(container: Path) -> None:
    for name, content in {"max": "1000000", "current": "900000", "stat": "anon 1\ninactive_file 50000\n"}.items():
        (container / f"memory.{name}").write_text(content)
    assert available_memory() == 150_000
    (container / "memory.max").write_text("max\n")
    assert (available_memory() or 0) > 150_000  # of the machine, where it says so
