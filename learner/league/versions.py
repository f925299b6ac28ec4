"""The folder `league` of a run: kept versions of its policy, and policies of other runs, one sealed directory each."""

import hashlib
import logging
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors
import safetensors.numpy

from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.hub import HubError, pull
from daedalus.policy.saving.saved_policy import (
    FORMAT,
    PARAMETERS_FILE,
    POLICY_LIMITS,
    NoPolicyError,
    SavedPolicy,
    export_policy,
    find_policy,
    read_policy,
)
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory, is_unfinished, remove_sealed, write_sealed

_logger = logging.getLogger(__name__)


class KeptVersion(NamedTuple):
    """A kept version of the policy, and after how many env_steps it was kept."""

    policy_version: int
    env_steps: int


def thinned(kept: Sequence[KeptVersion], most: int) -> list[KeptVersion]:
    """Return which versions stay if there may be `most`: the first and the newest, and others at even distances.

    Those go whose neighbours are nearest to each other in env_steps, of equal ones the oldest. The newest alone stays
    if there may be one.
    """
    stay = sorted(kept)
    if most == 1:
        return stay[-1:]
    while len(stay) > most:
        distances = [after.env_steps - before.env_steps for before, after in zip(stay, stay[2:], strict=False)]
        del stay[1 + distances.index(min(distances))]
    return stay


def encoded(weights: Mapping[str, np.ndarray]) -> bytes:
    """Return a copy of weights in the form of a file."""
    return safetensors.numpy.save(dict(weights))


class VersionFolder:
    """The kept versions of one run. A version exists completely or not at all; its files do not change."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def versions(self) -> list[KeptVersion]:
        """Return the versions that the folder has, from old to new. Log a warning for each that is damaged.

        What a crash has left unfinished is removed.
        """
        for unfinished in self._folder.glob(".*"):
            if is_unfinished(unfinished):
                shutil.rmtree(unfinished, ignore_errors=True)
        found = []
        for entry in sorted(self._folder.iterdir()) if self._folder.is_dir() else ():
            if re.fullmatch("[0-9]{10,}", entry.name):
                try:
                    found.append(KeptVersion(int(entry.name), _env_steps(entry, SealedDirectory(entry))))
                except DamagedError as error:
                    _logger.warning("version %d of the league does not play: %s", int(entry.name), error)
        return found

    def write(self, version: KeptVersion, weights: bytes) -> None:
        """Write a version with `encoded` weights. Raises OSError; then nothing of it remains."""
        content = {"format": FORMAT, "policy_version": version.policy_version, "env_steps": version.env_steps}
        write_sealed(self._path(version.policy_version), {PARAMETERS_FILE: weights}, content)

    def read(self, policy_version: int) -> dict[str, np.ndarray]:
        """Return the weights of a version. Raises DamagedError if it is missing, damaged or of another release."""
        directory = self._path(policy_version)
        sealed = SealedDirectory(directory)
        _env_steps(directory, sealed)
        try:
            return safetensors.numpy.load(sealed.read(PARAMETERS_FILE, POLICY_LIMITS[PARAMETERS_FILE]))
        except (ValueError, safetensors.SafetensorError) as error:
            raise DamagedError(f"{directory}: written by another release ({type(error).__name__})") from None

    def remove(self, policy_version: int) -> None:
        """Remove a version, if the folder has it."""
        remove_sealed(self._path(policy_version))

    def _path(self, policy_version: int) -> Path:
        return self._folder / f"{policy_version:010d}"


def _env_steps(directory: Path, sealed: SealedDirectory) -> int:
    """Return after how many env_steps a version was kept. Raises DamagedError if another release wrote it."""
    env_steps = sealed.content.get("env_steps")
    if sealed.content.get("format") != FORMAT or not isinstance(env_steps, int) or not 0 <= env_steps < 2**63:
        raise DamagedError(f"{directory}: written by another release")
    return env_steps


def opponent_copy(name: str, folder: Path) -> Path:
    """Return where the copy of the policy of another run is, or will be."""
    return folder / f"opponent_{hashlib.sha256(name.encode()).hexdigest()[:16]}"


def opponent_run(name: str, folder: Path) -> SavedPolicy:
    """Return the policy of another run that is an opponent; the first call copies it into this run.

    The copy stays the opponent: the other run may go on, and a rating belongs to one policy.

    Args:
      name: a run directory, one of its checkpoints, or USER/NAME on the Hub.
      folder: has the copies of this run, or will have them.

    Raises SettingsError, which names the opponent.
    """
    copy = opponent_copy(name, folder)
    try:
        if copy.exists():
            return read_policy(copy)
        source, (owner, _, rest) = Path(name), name.partition("/")
        if not source.exists() and rest and "/" not in rest and owner not in (".", "..", "~", ""):
            source = pull(name)
        policy = find_policy(source)
        export_policy(policy.directory, copy)
    except (HubError, NoPolicyError, DamagedError) as error:
        again = f"; remove {copy} to read {name} again" if copy.exists() else ""
        raise SettingsError(f"league.opponents: {name} cannot be loaded: {error}{again}") from None
    except OSError as error:
        raise SettingsError(f"league.opponents: {name} cannot be copied to {copy}: {error.strerror or error}") from None
    _logger.info("opponent %s: policy version %d of %s", name, policy.policy_version, policy.directory)
    return policy
