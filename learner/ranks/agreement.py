"""What all ranks must agree on before they learn together."""

import json
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import torch
from pydantic import ValidationError

from daedalus.learner.ranks.errors import RanksDisagreeError
from daedalus.protocol.spec import RunSpec

Options = dict[str, Any]  # of the command line, by name


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """The run, as rank 0 announces it."""

    spec: RunSpec
    options: Options | None  # that define the run; None: rank 0 has started the other ranks itself
    versions: dict[str, str]


def this_run(spec: RunSpec, options: Options | None) -> Run:
    """Return a run for this process."""
    return Run(spec=spec, options=options, versions=_versions())


def described(run: Run) -> str:
    """Return the announcement of a run."""
    content = {"versions": run.versions, "options": run.options, "spec": run.spec.model_dump(mode="json")}
    return json.dumps(content)


def checked(announcement: str, options: Options | None) -> RunSpec:
    """Return the settings of the run that rank 0 announces.

    Args:
      announcement: what rank 0 announces.
      options: of the command line of this process; None: rank 0 has started it.

    Raises RanksDisagreeError if this process is of another version, or was started with other options.
    """
    try:
        content = json.loads(announcement)
        versions, theirs = dict(content["versions"]), content["options"]
    except (ValueError, KeyError, TypeError):
        raise RanksDisagreeError("rank 0 is of another release: install the same one on all hosts") from None
    for name, own in _versions().items():
        if versions.get(name) != own:
            raise RanksDisagreeError(
                f"{name} {own} is installed, and rank 0 has {versions.get(name)}: install the same release on all hosts"
            )
    for name, own in (options or {}).items():
        if theirs is None or theirs.get(name) != own:
            other = None if theirs is None else theirs.get(name)
            raise RanksDisagreeError(
                f"{name} is {own!r}, and that of rank 0 {other!r}: start all ranks with the same command"
            )
    try:
        return RunSpec.model_validate(content["spec"])
    except (KeyError, ValidationError):
        raise RanksDisagreeError("the settings of rank 0 are not valid here: install the same release") from None


def _versions() -> dict[str, str]:
    return {"daedalus": version("daedalus-rl"), "torch": torch.__version__.partition("+")[0]}
