"""What the benchmarks share: running commands of this checkout, and printing tables."""

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
    """Runs `daedalus train ARGUMENTS` in a folder of its own; its summary, with `exit_status` added."""
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
    """One line on what the figures were measured on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    return f"{os.cpu_count()} x {model}, Python {platform.python_version()}"


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
