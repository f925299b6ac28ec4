"""Shared parts of the benchmarks: run commands of this checkout, and print tables."""

import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

COMMAND = [sys.executable, "-P", "-c", "from daedalus.cli.main import main; raise SystemExit(main())"]


def train(*arguments: object) -> dict[str, Any]:
    """Run `daedalus train ARGUMENTS` in a temporary folder; return its summary with `exit_status`."""
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "run"
        words = [str(argument) for argument in arguments]
        finished = subprocess.run(
            [*COMMAND, "train", *words, "--run-dir", str(directory)], capture_output=True, text=True, check=False
        )
        if finished.returncode not in (0, 3):
            raise SystemExit(f"daedalus train {' '.join(words)} failed:\n{finished.stdout}{finished.stderr}")
        summary = json.loads((directory / "summary.json").read_text())
    return {**summary, "exit_status": finished.returncode}


def machine() -> str:
    """Return one line that describes this machine."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    return f"{os.cpu_count()} x {model}, Python {platform.python_version()}"


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
