"""The directory of a run: its files, and functions that read and write them. Only its owner may enter a new one.

config.toml      all settings; reproduces the run      metrics.csv   one row for each log interval
versions.json    versions of the packages              checkpoints/  by policy version; the newest are kept
summary.json     result of the run                     events.*      the same metrics for TensorBoard
learner.lock     locked by the learner that runs
config.toml.before  the settings before those of a resumed run, until its learner begins with them
heartbeat        its age shows that the learner works (heartbeat.py)
events.jsonl     what happened: actors that joined and left, rejections, restarts (serving/events.py)
evaluation.json  result of the final evaluation, with the return of each episode
output.log       what actors and evaluations printed, if anything; output.log.1 is the part before it
report.html      a page about the run, which `daedalus train` leaves at its end
tracker-*.json   how far each tracker has logged the run
labels.json      tags and a note, by daedalus runs
league/          of a game: kept versions of the policy, and the policies of other runs that are opponents
"""

import itertools
import json
import os
import platform
import re
import shlex
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import tomli_w

from daedalus.learner.run import run_files
from daedalus.learner.run.heartbeat import HEARTBEAT
from daedalus.learner.run.run_lock import LOCK, RunLock
from daedalus.learner.run.settings import SettingsError, as_toml, read_settings, run_spec
from daedalus.policy.saving.regular_files import replace_text
from daedalus.policy.saving.sealed import remove_sealed
from daedalus.protocol import keys
from daedalus.protocol.releases import as_release, own_release, remedy
from daedalus.protocol.spec import RunSpec
from daedalus.transport.process_usage import available_processors

CONFIG, VERSIONS, SUMMARY, METRICS = "config.toml", "versions.json", "summary.json", "metrics.csv"
CONFIG_BEFORE = "config.toml.before"  # the settings before a resumed run's, until its learner begins with those
OPERATOR_TOKEN = "operator-token"  # for the page of a run that is watched
OUTPUT, EVALUATION, EVENTS = "output.log", "evaluation.json", "events.jsonl"
CONFIRMATION_OUTPUT = "confirmation.log"  # of a learner's evaluator, where the launcher writes output.log
REPORT, LABELS = "report.html", "labels.json"
DEMONSTRATIONS = "demonstrations"  # folder of rollouts (demonstration_files.py)
LEAGUE = "league"  # folder of kept versions and of other runs' policies that are opponents
TRACKER = "tracker-{}.json"  # how far a tracker such as wandb has logged the run
_WRITTEN_BY = "# written by "  # first line of config.toml, with the release
_SUPERSEDED = "superseded_by"  # in summary.json: the epoch of the newer learner
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


def run_name(directory: Path) -> str:
    """Return the name of the run in a directory: the directory's own, in the characters that a name may have."""
    return keys.as_name(Path(os.path.abspath(directory)).name)  # of a link, its own name


def default_directory(name: str, spec: RunSpec) -> Path:
    """Return the default directory of a new run: runs/NAME-ALGORITHM-sSEED-TIME."""
    parts = (name, spec.training.algorithm.rpartition(":")[2])  # the class of `module:Class`
    plain = "-".join(re.sub(r"[^A-Za-z0-9]+", "-", part).strip("-") for part in parts)
    return Path("runs") / f"{plain}-s{spec.training.seed}-{time.strftime('%Y%m%d-%H%M%S')}"


def role_directory(parent: Path, role: str) -> Path:
    """Return the directory of the run of one role of a game. Its name is unique beside other runs of the network."""
    return parent / f"{Path(os.path.abspath(parent)).name}-{re.sub(r'[^A-Za-z0-9._-]+', '-', role)}"


def role_directories(parent: Path) -> dict[str, Path]:
    """Return the directories of the runs in a directory with one run for each role, by role. Empty for any other."""
    prefix = role_directory(parent, "").name
    runs = [] if (parent / CONFIG).exists() else [each.parent for each in sorted(parent.glob(f"*/{CONFIG}"))]
    return {run.name.removeprefix(prefix): run for run in runs if run.name.startswith(prefix)}


def check_free(directory: Path, again: str = "daedalus resume") -> None:
    """Check that a directory is free for a new run. Raises SettingsError if it is a file or not empty.

    `again` is the command that continues a run, without its directory: the error names it.
    """
    if not directory.exists():
        return
    if not directory.is_dir():
        raise SettingsError(f"run directory {directory} is a file: choose a directory with --run-dir")
    if (directory / CONFIG).exists():
        raise SettingsError(
            f"run directory {directory} exists: continue the run with `{again} {shlex.quote(str(directory))}`, "
            "or choose another directory with --run-dir"
        )
    if role_directories(directory):
        raise SettingsError(
            f"run directory {directory} has the runs of several roles: continue them with `daedalus resume "
            f"{shlex.quote(str(directory))}`, or choose another directory with --run-dir"
        )
    if any(entry.name != LOCK for entry in directory.iterdir()):
        raise SettingsError(
            f"run directory {directory} is not empty, and has no {CONFIG}: choose another directory with --run-dir"
        )


@contextmanager
def made(directory: Path) -> Iterator[None]:
    """Make a directory before its run is created, and remove it at the end if it is empty. Raises SettingsError."""
    try:
        directory.mkdir(0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"run directory {directory}: {error.strerror}") from None
    try:
        yield
    finally:
        with suppress(OSError):
            directory.rmdir()


def create(directory: Path, spec: RunSpec) -> None:
    """Create the directory of a new run, with config.toml and versions.json. See create_locked."""
    create_locked(directory, spec).close()


def create_locked(
    directory: Path,
    spec: RunSpec,
    *,
    numbered: bool = False,
    init_from: Path | None = None,
    other_spaces: bool = False,
) -> RunLock:
    """Create the directory of a new run, with config.toml and versions.json, and return its lock.

    Args:
      directory: its path.
      spec: the settings of the run.
      numbered: add a number to the name if the directory exists; the lock has the resulting path.
      init_from: run whose weights the new run begins with, for versions.json, with its absolute path.
      other_spaces: whether its spaces may be others, for versions.json.

    Raises SettingsError if the directory is not empty, locked, or cannot be created.
    """
    try:
        if numbered:
            directory = make_numbered(directory)
        check_free(directory)
        directory.mkdir(0o700, parents=True, exist_ok=True)
        lock = RunLock(directory)
        try:
            check_free(directory)  # another process may have held the lock before
            write_config(directory, spec)
            origin: dict[str, Any] = {} if init_from is None else {"init_from": os.path.abspath(init_from)}
            if other_spaces:
                origin["init_from_other_spaces"] = True
            write_json(directory / VERSIONS, {**_versions(), **origin})
        except BaseException:
            lock.close()
            raise
        return lock
    except OSError as error:
        raise SettingsError(f"run directory {directory}: {error.strerror}") from None


def make_numbered(directory: Path) -> Path:
    """Create a new directory with this name, or with the first number that makes its name new. Raises OSError."""
    for number in itertools.count(1):
        numbered = directory if number == 1 else directory.with_name(f"{directory.name}-{number}")
        with suppress(FileExistsError):
            numbered.mkdir(0o700, parents=True)
            return numbered
    raise AssertionError


def remove_failed(directory: Path) -> None:
    """Remove the files of a run that failed before it had a result, and the directory unless it has other files."""
    if (directory / METRICS).exists() or any((directory / "checkpoints").glob("*")):
        return
    for pattern in (
        CONFIG,
        VERSIONS,
        SUMMARY,
        f"{OUTPUT}*",
        EVENTS,
        LOCK,
        HEARTBEAT,
        OPERATOR_TOKEN,
        TRACKER.format("*"),
        "events.out.*",
        ".*.partial",
    ):
        for file in directory.glob(pattern):
            with suppress(OSError):
                file.unlink()
    for sealed in (*(directory / LEAGUE).glob("*"), *(directory / DEMONSTRATIONS).glob("*")):
        remove_sealed(sealed)
    for folder in (directory / "checkpoints", directory / LEAGUE, directory / DEMONSTRATIONS, directory):
        with suppress(OSError):  # not empty, or a mount point
            folder.rmdir()


def write_config(directory: Path, spec: RunSpec) -> None:
    """Write config.toml: all settings, including defaults; unset settings are omitted. Raises SettingsError."""
    derived = {"training": {"algorithm_record"}}  # it is read from the class of the algorithm again
    text = f"{_WRITTEN_BY}{own_release()}\n" + tomli_w.dumps(
        as_toml(spec.model_dump(mode="json", exclude_none=True, exclude=derived))
    )
    try:
        replace_text(directory / CONFIG, text)
    except OSError as error:
        raise SettingsError(f"{directory / CONFIG} cannot be written: {error.strerror}") from None


def change_config(directory: Path, spec: RunSpec) -> None:
    """Write the settings with which a run is to continue; `restore_config` takes them back until `accept_config`.

    Raises SettingsError.
    """
    before = directory / CONFIG_BEFORE
    try:
        if not before.exists():  # else a process ended in between: those are the last settings that were accepted
            shutil.copyfile(directory / CONFIG, before)
    except OSError as error:
        raise SettingsError(f"{before} cannot be written: {error.strerror}") from None
    write_config(directory, spec)


def accept_config(directory: Path) -> None:
    """Keep changed settings: the learner has begun with them."""
    with suppress(OSError):  # the next change keeps the older settings beside its own, at worst
        (directory / CONFIG_BEFORE).unlink(missing_ok=True)


def restore_config(directory: Path) -> bool:
    """Take changed settings back that were not accepted, and return whether there were any."""
    try:
        os.replace(directory / CONFIG_BEFORE, directory / CONFIG)
    except OSError:
        return False
    return True


def read_config(directory: Path) -> RunSpec:
    """Return the specification of a run. Raises SettingsError if the directory has no valid config.toml."""
    if not (directory / CONFIG).is_file():
        raise SettingsError(f"{directory} is not a run directory: it has no {CONFIG}")
    settings = read_settings(directory / CONFIG)
    try:
        return run_spec(settings)
    except SettingsError as error:
        other = remedy(releases_of(directory)[1])
        raise SettingsError(f"{directory / CONFIG}: {error}{f'; {other}' if other else ''}") from None


def releases_of(directory: Path) -> tuple[str, str]:
    """Return which release of daedalus-rl made a run, and which wrote its settings last; empty texts if not known.

    A run that a newer release has resumed has the settings of that one. Raises SettingsError.
    """
    try:
        stated = (run_files.read_json(directory / VERSIONS) or {}).get(_PACKAGES[0])
        first = (run_files.read_file(directory / CONFIG, run_files.MAX_TOML_BYTES) or b"").partition(b"\n")[0]
    except run_files.RunDataError as error:
        raise SettingsError(str(error)) from None
    made = as_release(f"{_PACKAGES[0]} {stated}")
    line = first.decode(errors="replace").rstrip("\r")
    return made, as_release(line.removeprefix(_WRITTEN_BY)) if line.startswith(_WRITTEN_BY) else made


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file atomically. Raises OSError."""
    replace_text(path, json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file of a run directory. Raises SettingsError if it is missing or damaged."""
    try:
        content = run_files.read_json(path)
    except run_files.RunDataError as error:
        raise SettingsError(str(error)) from None
    if content is None:
        raise SettingsError(f"{path} does not exist")
    return content


def note_superseded(directory: Path, learner_epoch: int) -> None:
    """Note in summary.json that a newer learner, in another copy of this directory, has taken over. Raises OSError.

    No supervisor can tell a learner that must not return from one that failed. With this note it does not serve again.
    """
    try:
        summary = read_json(directory / SUMMARY)
    except SettingsError:
        summary = {}
    write_json(directory / SUMMARY, {**summary, _SUPERSEDED: f"{learner_epoch:x}"})


def why_superseded(directory: Path) -> str:
    """Return why the run must not be continued in this directory, and what to do; empty if it may."""
    with suppress(SettingsError):
        if newer := read_json(directory / SUMMARY).get(_SUPERSEDED):
            return (
                f"{directory}: a newer learner of this run (epoch {newer}) took over: the run goes on in "
                f"the directory of that one. To continue this copy all the same, remove {directory / SUMMARY}"
            )
    return ""


def _versions() -> dict[str, Any]:
    import importlib.metadata  # imported here, because only a new run needs it

    versions: dict[str, Any] = {"python": platform.python_version(), "platform": platform.platform()}
    versions["processors"] = available_processors()
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return versions
