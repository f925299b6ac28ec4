"""The directory of a run: what lies where, and how it gets there.

config.toml      complete; reproduces the run          metrics.csv   one row a log interval
versions.json    what it ran on                        checkpoints/  by policy version, newest kept
summary.json     how it ended                          events.*      the same metrics for TensorBoard
"""

import json
import os
import platform
import re
import time
from pathlib import Path
from typing import Any

import tomli_w

from daedalus.learner.run.settings import SettingsError, read_file, run_spec
from daedalus.protocol.spec import RunSpec

CONFIG, VERSIONS, SUMMARY, METRICS = "config.toml", "versions.json", "summary.json", "metrics.csv"
_PACKAGES = (
    "daedalus-rl",
    "torch",
    "numpy",
    "gymnasium",
    "eclipse-zenoh",
    "msgpack",
    "zstandard",
    "onnxruntime",
    "pydantic",
)


def default_directory(name: str, spec: RunSpec) -> Path:
    """Where a run goes that was not told where: runs/NAME-ALGORITHM-SEED-TIME."""
    plain = re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return Path("runs") / f"{plain}-{spec.training.algorithm}-s{spec.training.seed}-{stamp}"


def check_free(directory: Path) -> None:
    """Raises SettingsError if a new run cannot go there, because something else is there already."""
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise SettingsError(
            f"run directory {directory} exists: continue it with `daedalus resume {directory}`, "
            "or name another with --run-dir"
        )


def create(directory: Path, spec: RunSpec) -> None:
    """Makes the directory of a new run and writes what is known before it starts.

    Raises SettingsError if it exists and is not empty.
    """
    check_free(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_config(directory, spec)
        write_json(directory / VERSIONS, _versions())
    except OSError as error:
        raise SettingsError(f"run directory {directory}: {error.strerror}") from None


def write_config(directory: Path, spec: RunSpec) -> None:
    """Writes config.toml: every setting, the defaults too; those that are unset are left out."""
    text = tomli_w.dumps(spec.model_dump(mode="json", exclude_none=True))
    _replace(directory / CONFIG, text)


def read_config(directory: Path) -> RunSpec:
    """The specification of a run. Raises SettingsError if the directory holds none."""
    if not (directory / CONFIG).is_file():
        raise SettingsError(f"{directory} is not a run directory: it has no {CONFIG}")
    return run_spec(read_file(directory / CONFIG))


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a JSON file as a whole or not at all."""
    _replace(path, json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON file of a run directory. Raises SettingsError if it is not there or not whole."""
    try:
        return json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}") from None
    except ValueError:
        raise SettingsError(f"{path} is damaged") from None


def _replace(path: Path, text: str) -> None:
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    beside.write_text(text, "utf-8")
    os.replace(beside, path)


def _versions() -> dict[str, Any]:
    import importlib.metadata  # only a new run wants it

    versions: dict[str, Any] = {"python": platform.python_version(), "platform": platform.platform()}
    versions["processors"] = os.cpu_count()
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return versions


def with_budget(spec: RunSpec, env_steps: int) -> RunSpec:
    """The same run with another budget. Raises SettingsError if it is none."""
    settings = spec.model_dump(mode="json", exclude_none=True)
    settings["training"]["env_steps"] = env_steps
    return run_spec(settings)
