"""Reading a policy from a checkpoint: the program, its weights, and the specification of the environment.

A checkpoint (learner/training/checkpoint.py) is a sealed directory. This file reads only the entries that acting needs,
so an evaluator needs neither torch nor the learner's code. Checkpoints of a run are named by policy version, pretrained
policies by their own names; best_checkpoints.py handles the best of a run.
"""

import difflib
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import safetensors
import safetensors.numpy
from pydantic import Field, TypeAdapter, ValidationError

from daedalus.policy.acting.program_check import MAX_PROGRAM_BYTES
from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_in_training, newest_return, training_score
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, write_sealed
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.releases import remedy, unknown_settings
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_logger = logging.getLogger(__name__)

PROGRAM_FILE, PARAMETERS_FILE = "program.onnx", "parameters.safetensors"
# Size of each file of a policy, in bytes.
POLICY_LIMITS = {PROGRAM_FILE: MAX_PROGRAM_BYTES, PARAMETERS_FILE: LEARNER_LIMITS.max_bytes}
FORMAT = 2  # of the spaces, the program and the names of the parameters; older releases wrote no number
PRETRAINED = Path(__file__).parents[1] / "pretrained"
_VERSION = TypeAdapter(Annotated[int, Field(ge=0, lt=2**63, strict=True)])


class OtherFormatError(DamagedError):
    """A checkpoint of another format, which another release wrote."""


class NoPolicyError(Exception):
    """No policy has the given name, or is in the given directory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SavedPolicy:
    """A policy read from a checkpoint."""

    directory: Path
    policy_version: int
    spec: RunSpec
    spaces: Spaces
    program: bytes
    weights: dict[str, np.ndarray]


def checkpoint_path(run_directory: Path, policy_version: int) -> Path:
    """Return the directory of the checkpoint of a policy version, which may not exist."""
    return run_directory / "checkpoints" / f"{policy_version:010d}"


def checkpoints(run_directory: Path) -> list[Path]:
    """Return the checkpoints of a run, newest first."""
    folder = run_directory / "checkpoints"
    if not folder.is_dir():
        return []
    return sorted((entry for entry in folder.iterdir() if re.fullmatch("[0-9]{10,}", entry.name)), reverse=True)


def find_policy(directory: Path, newest: bool = False) -> SavedPolicy:
    """Return the policy of a checkpoint, or the best policy of a run directory.

    The best is that with the highest score of an evaluation; if no checkpoint has one, that with the highest score of
    training episodes. The newest policy of the run is returned if no checkpoint has a score or `newest` is true.
    Damaged checkpoints are logged and skipped.

    Raises NoPolicyError if there is no checkpoint, DamagedError if none is readable, OtherFormatError for a run of
    another release.
    """
    if (directory / "manifest.json").exists():
        return read_policy(directory)
    best = [] if newest else [*best_checkpoints(directory), *best_in_training(directory)]
    candidates = [*best, *checkpoints(directory)]
    if not candidates:
        raise NoPolicyError(_no_checkpoints(directory))
    for candidate in candidates:
        try:
            return read_policy(candidate)
        except OtherFormatError:
            raise
        except DamagedError as error:
            _logger.warning("skipped a damaged checkpoint: %s", error)
    raise DamagedError(f"{directory} has no readable checkpoint")


def candidates(run_directory: Path) -> list[Path]:
    """Return the checkpoints among which the best is selected after a run. A version may be there twice.

    They are those with the best scores of evaluations and of training episodes, and the newest. Training episodes have
    scores while nobody evaluates: where somebody did, only those count that were better than the newest. Returns an
    empty list where there is nothing to select: if no checkpoint has a score, or if there was no evaluation and the
    newest checkpoint was the best in training.
    """
    evaluated, trained = best_checkpoints(run_directory), best_in_training(run_directory)
    newest = checkpoints(run_directory)[:1]
    if evaluated and newest and (reached := newest_return(newest[0])) is not None:
        trained = [each for each in trained if (score := training_score(each)) is not None and score > reached]
    return [] if not evaluated and trained[:1] in ([], newest) else [*evaluated, *trained, *newest]


def read_candidates(run_directory: Path) -> list[SavedPolicy]:
    """Return the policies of `candidates`, each version once. Logs a warning for each damaged checkpoint."""
    found: dict[int, SavedPolicy] = {}
    for directory in candidates(run_directory):
        try:
            policy = read_policy(directory)
        except DamagedError as error:
            _logger.warning("damaged checkpoint skipped: %s", error)
        else:
            found.setdefault(policy.policy_version, policy)
    return list(found.values())


def _no_checkpoints(directory: Path) -> str:
    if not directory.exists():
        return f"{directory} does not exist: name a run directory or one of its checkpoints"
    if (directory / "config.toml").exists():
        return f"{directory} has no checkpoints yet: its learner saves the first one after service.checkpoint_seconds"
    return f"{directory} has no checkpoints: is it a run directory?"


def pretrained(name: str) -> Path:
    """Return the checkpoint of a policy that ships with the package. Raises NoPolicyError for an unknown name."""
    names = sorted(entry.parent.name for entry in PRETRAINED.glob("*/manifest.json"))
    if name not in names:
        near = difflib.get_close_matches(name, names, 1, 0.5)
        hint = f"did you mean {near[0]}? " if near else ""
        choices = f"choose from {', '.join(names)}" if names else "none ships with this release"
        raise NoPolicyError(f"no pretrained policy {name!r}: {hint}{choices}")
    return PRETRAINED / name


def export_policy(checkpoint: Path, target: Path) -> None:
    """Write the policy of `checkpoint`, without the learner's state, as the sealed directory `target`.

    Raises DamagedError if the checkpoint is damaged, OSError if writing fails.
    """
    sealed = SealedDirectory(checkpoint)
    files = {name: sealed.read(name, limit) for name, limit in POLICY_LIMITS.items()}
    write_sealed(target, files, sealed.content)


def check_format(directory: Path, sealed: SealedDirectory) -> None:
    """Raise OtherFormatError unless this release reads the checkpoint in a directory."""
    found = sealed.content.get("format", 1)
    if found != FORMAT:
        other = remedy(sealed.content.get("release")) or "use the release that wrote it"
        raise OtherFormatError(
            f"{directory} has format {str(found)[:20]} of checkpoints, and this release reads format {FORMAT} only: "
            f"{other}, or train again from the run's config.toml"
        )


def read_policy(directory: Path) -> SavedPolicy:
    """Return the policy of a checkpoint. Raises DamagedError if damaged, OtherFormatError for another format."""
    sealed = SealedDirectory(directory)
    check_format(directory, sealed)
    other = remedy(sealed.content.get("release"))
    try:
        return SavedPolicy(
            directory=directory,
            policy_version=_VERSION.validate_python(sealed.content["policy_version"]),
            spec=RunSpec.model_validate(sealed.content["spec"]),
            spaces=Spaces.model_validate(sealed.content["spaces"]),
            program=sealed.read(PROGRAM_FILE, POLICY_LIMITS[PROGRAM_FILE]),
            weights=safetensors.numpy.load(sealed.read(PARAMETERS_FILE, POLICY_LIMITS[PARAMETERS_FILE])),
        )
    except ValidationError as error:
        reason = unknown_settings(error)
    except (KeyError, TypeError, ValueError, safetensors.SafetensorError) as error:
        reason = type(error).__name__
    raise DamagedError(f"{directory}: written by another release ({reason}){f'; {other}' if other else ''}")
