"""Checkpoints: the learner's full restart state, written atomically and verified on load.

A checkpoint is a sealed directory (policy/saving/sealed.py) named by its policy version. Its policy part can also be
read by policy/saving/saved_policy.py; this file adds the state that training continues from.
"""

import logging
import os
import shutil
from collections.abc import Iterable, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
import safetensors.torch
from torch import Tensor

from daedalus.learner.run.counters import check_counters
from daedalus.policy.saving.best_checkpoints import TrainingScore, keep_if_best, training_score
from daedalus.policy.saving.saved_policy import (
    FORMAT,
    PARAMETERS_FILE,
    PROGRAM_FILE,
    OtherFormatError,
    SavedPolicy,
    checkpoint_path,
    checkpoints,
    read_policy,
)
from daedalus.policy.saving.sealed import (
    DamagedError,
    SealedDirectory,
    UnreadableError,
    is_unfinished,
    remove_sealed,
    write_sealed,
)
from daedalus.protocol.releases import own_release, remedy
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_logger = logging.getLogger(__name__)

_STATE_FILE = "learner.safetensors"
_MAX_STATE_BYTES = 8 << 30  # several times the largest parameters


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checkpoint:
    """Full restart state of a learner."""

    policy: SavedPolicy
    state: dict[str, Tensor]  # optimiser statistics and random state, from Learner.state
    counters: dict[str, Any]  # from RunCounters.state


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EncodedCheckpoint:
    """Content of a checkpoint in memory of its own, which no update changes: another thread may write it."""

    policy_version: int
    files: dict[str, bytes]
    content: dict[str, Any]


def encode_checkpoint(
    *,
    spec: RunSpec,
    spaces: Spaces,
    policy_version: int,
    program: bytes,
    parameters: dict[str, np.ndarray],
    state: dict[str, Tensor],
    counters: dict[str, Any],
    score: TrainingScore | None = None,
) -> EncodedCheckpoint:
    """Copy the state of a learner, between two updates; `score` is of the training episodes, if there is one."""
    files = {
        PROGRAM_FILE: program,
        PARAMETERS_FILE: safetensors.numpy.save(parameters),
        _STATE_FILE: safetensors.torch.save(state),
    }
    content = {
        "format": FORMAT,
        "release": own_release(),
        "policy_version": policy_version,
        "spec": spec.model_dump(mode="json"),
        "spaces": spaces.model_dump(mode="json"),
        "counters": counters,
        **({} if score is None else {"score": score.described()}),
    }
    return EncodedCheckpoint(policy_version=policy_version, files=files, content=content)


def save_checkpoint(
    run_directory: Path, encoded: EncodedCheckpoint, *, keep: int, also_keep: Set[Path] = frozenset()
) -> Path:
    """Write a checkpoint, remove all others but the newest `keep` and `also_keep`, and return its directory.

    Those that are among the best by their training episodes are kept under their score.

    Raises OSError on a disk error; the existing checkpoints then stay.
    """
    directory = checkpoint_path(run_directory, encoded.policy_version)
    write_sealed(directory, encoded.files, encoded.content)
    # A damaged checkpoint of a higher version may exist, if it could not be set aside.
    others = [other for other in checkpoints(run_directory) if other != directory]
    for old in others[keep - 1 :]:
        if old not in also_keep:
            try:
                if (score := training_score(old)) is not None:
                    keep_if_best(old, score, int(old.name), training=True)
            except OSError as error:  # it is not removed: it may be the best
                _logger.warning("%s cannot be kept under its score: %s", old, error.strerror or error)
                continue
            remove_sealed(old)
    for unfinished in directory.parent.glob(".*"):  # left by a crash, or set aside
        if is_unfinished(unfinished):
            shutil.rmtree(unfinished, ignore_errors=True)
    return directory


def load_checkpoint(directory: Path) -> Checkpoint:
    """Read one checkpoint. Raises DamagedError if its files differ from the files that were written."""
    policy = read_policy(directory)
    sealed = SealedDirectory(directory)
    try:
        state = safetensors.torch.load(sealed.read(_STATE_FILE, _MAX_STATE_BYTES))
        counters = check_counters(sealed.content["counters"])
    except (KeyError, ValueError, safetensors.SafetensorError) as error:
        other = remedy(sealed.content.get("release")) or "resume the run with that release"
        raise DamagedError(f"{directory}: damaged, or of another release ({type(error).__name__}): {other}") from None
    return Checkpoint(policy=policy, state=state, counters=counters)


def load_newest(run_directory: Path) -> Checkpoint:
    """Return the newest undamaged checkpoint, and set aside the newer ones with one warning that names them.

    The learner continues from the returned checkpoint, so that the newer ones are no longer the newest of the run.

    Raises DamagedError if there is no undamaged checkpoint, UnreadableError if a newer one cannot be read now,
    OtherFormatError for a run of another release.
    """
    loaded, damaged = None, dict[Path, DamagedError]()
    for directory in checkpoints(run_directory):
        try:
            loaded = load_checkpoint(directory)
            break
        except OtherFormatError:
            raise
        except UnreadableError as error:
            raise UnreadableError(f"{error}, or remove {directory} to continue without it") from None
        except DamagedError as error:
            damaged[directory] = error
    if damaged:
        _logger.warning("damaged checkpoints skipped: %s", "; ".join(map(str, damaged.values())))
    if loaded is None:
        raise DamagedError(f"{run_directory} has no readable checkpoint: start a new run with another --run-dir")
    _set_aside(damaged)
    return loaded


def _set_aside(damaged: Iterable[Path]) -> None:
    """Give damaged checkpoints names that nothing takes for checkpoints. The next save removes them."""
    for directory in damaged:
        aside = directory.with_name(f".{directory.name}.damaged")
        shutil.rmtree(aside, ignore_errors=True)
        try:
            os.replace(directory, aside)
        except OSError as error:
            text = "%s cannot be set aside: %s; remove it, because it counts as newer than those that training saves"
            _logger.warning(text, directory, error.strerror or error)
