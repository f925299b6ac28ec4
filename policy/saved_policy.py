"""The part of a checkpoint that can play: program, weights, and what environment they are for.

A checkpoint (learner/checkpoint.py) is a sealed directory; this file knows the entries of it that acting
needs, so that an evaluator reads them without torch and without the learner's code.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from policy.sealed import DamagedError, SealedDirectory
from protocol.spec import RunSpec, Spaces

PROGRAM_FILE, PARAMETERS_FILE = "program.onnx", "parameters.safetensors"


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
