"""Shared parts of the benchmarks: run commands of this checkout, and print tables."""

import csv
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

COMMAND = [sys.executable, "-P", "-c", "from daedalus.cli.main import main; raise SystemExit(main())"]
_WARM_SECONDS = 10.0


def train(*arguments: object) -> dict[str, Any]:
    """Run `daedalus train ARGUMENTS` in a temporary folder; return its summary with `exit_status`."""
    with tempfile.TemporaryDirectory() as folder:
        return train_in(Path(folder) / "run", *arguments)


def train_in(directory: Path, *arguments: object) -> dict[str, Any]:
    """Run `daedalus train ARGUMENTS` in a run directory, which stays. See `train`."""
    words = [str(argument) for argument in arguments]
    command = [*COMMAND, "train", *words, "--run-dir", str(directory)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode not in (0, 3):
        raise SystemExit(f"daedalus train {' '.join(words)} failed:\n{finished.stdout}{finished.stderr}")
    return {**json.loads((directory / "summary.json").read_text()), "exit_status": finished.returncode}


def learning_rate(*arguments: object) -> float:
    """Run `daedalus train ARGUMENTS`; return the env_steps/s after the start of the processes and ten seconds."""
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "run"
        words = ["train", *map(str, arguments), "--run-dir", str(directory)]
        finished = subprocess.run([*COMMAND, *words], capture_output=True, text=True, check=False)
        if finished.returncode not in (0, 3):
            raise SystemExit(f"daedalus {' '.join(words)} failed:\n{finished.stdout}{finished.stderr}")
        with open(directory / "metrics.csv", newline="", encoding="utf-8") as file:
            points = [(float(row["wall_seconds"]), int(row["env_steps"])) for row in csv.DictReader(file)]
    warm = next((point for point in points if point[0] >= points[0][0] + _WARM_SECONDS), points[-1])
    if warm == points[-1]:
        raise SystemExit(f"the run took less than {_WARM_SECONDS:.0f} s after its start: give it more env_steps")
    return (points[-1][1] - warm[1]) / (points[-1][0] - warm[0])


def per_call(call: Callable[[int], object], seconds: float, warm_up: int = 20) -> float:
    """Return the CPU seconds per call, without the first calls."""
    for index in range(warm_up):
        call(index)
    calls, began, ends = 0, time.process_time(), time.monotonic() + seconds
    while time.monotonic() < ends:
        call(calls)
        calls += 1
    return (time.process_time() - began) / calls


def machine() -> str:
    """Return one line that describes this machine."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    return f"{os.cpu_count()} x {model}, Python {platform.python_version()}"


def cpu_seconds(pid: int) -> float:
    """Return the CPU time that a process has used, in user mode and in the kernel, without its children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
