"""The part of a checkpoint that can play: program, weights, and what environment they are for.

A checkpoint (learner/training/checkpoint.py) is a sealed directory; this file knows the entries of it that acting
needs, so that an evaluator reads them without torch and without the learner's code. It knows too by what names
they lie: a run's by policy version, those that ship with the package by their own. The best: best_checkpoints.py.
"""

import difflib
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from daedalus.policy.saving.best_checkpoints import best_checkpoints
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, write_sealed
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_logger = logging.getLogger(__name__)

PROGRAM_FILE, PARAMETERS_FILE = "program.onnx", "parameters.safetensors"
PRETRAINED = Path(__file__).parents[1] / "pretrained"


class NoPolicyError(Exception):
    """There is no such policy; the message says what there is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SavedPolicy:
    """A policy as it lies in a checkpoint."""

    directory: Path
    policy_version: int
    spec: RunSpec
    spaces: Spaces
    program: bytes
    weights: dict[str, np.ndarray]


def checkpoints(run_directory: Path) -> list[Path]:
    """The checkpoints of a run, newest first."""
    folder = run_directory / "checkpoints"
    if not folder.is_dir():
        return []
    return sorted((entry for entry in folder.iterdir() if entry.name.isdigit()), reverse=True)


def find_policy(directory: Path, newest: bool = False) -> SavedPolicy:
    """The policy of a checkpoint; of a run directory its best, or its newest if none is or `newest` is asked for.

    Damaged ones are named and passed over. Raises DamagedError if none is left.
    """
    if (directory / "manifest.json").exists():
        return read_policy(directory)
    candidates = [*([] if newest else best_checkpoints(directory)), *checkpoints(directory)]
    if not candidates:
        raise DamagedError(f"{directory} has no checkpoints: is it a run directory?")
    for candidate in candidates:
        try:
            return read_policy(candidate)
        except DamagedError as error:
            _logger.warning("passed over: %s", error)
    raise DamagedError(f"{directory} has no checkpoint that can be read")


def pretrained(name: str) -> Path:
    """The checkpoint of a policy that ships with the package. Raises NoPolicyError for an unknown name."""
    names = sorted(entry.parent.name for entry in PRETRAINED.glob("*/manifest.json"))
    if name not in names:
        near = difflib.get_close_matches(name, names, 1, 0.5)
        hint = f"did you mean {near[0]}? " if near else ""
        there_are = f"there are {', '.join(names)}" if names else "none ships with this release"
        raise NoPolicyError(f"no pretrained policy {name!r}: {hint}{there_are}")
    return PRETRAINED / name


def export_policy(checkpoint: Path, target: Path) -> None:
    """Writes the policy of `checkpoint`, without the learner's state, as the sealed directory `target`.

    Raises DamagedError if the checkpoint is not what was written, OSError if the disk refuses.
    """
    sealed = SealedDirectory(checkpoint)
    files = {name: sealed.read(name) for name in (PROGRAM_FILE, PARAMETERS_FILE)}
    write_sealed(target, files, sealed.content)


def read_policy(directory: Path) -> SavedPolicy:
    """The policy in one checkpoint; raises DamagedError if it is not what was written."""
    sealed = SealedDirectory(directory)
    try:
        return SavedPolicy(
            directory=directory,
            policy_version=int(sealed.content["policy_version"]),
            spec=RunSpec.model_validate(sealed.content["spec"]),
            spaces=Spaces.model_validate(sealed.content["spaces"]),
            program=sealed.read(PROGRAM_FILE),
            weights=safetensors.numpy.load(sealed.read(PARAMETERS_FILE)),
        )
    except (KeyError, TypeError, ValueError, safetensors.SafetensorError) as error:
        raise DamagedError(f"{directory}: written by another release ({type(error).__name__})") from None
