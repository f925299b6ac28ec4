"""The run whose weights a new run begins with."""

from pathlib import Path

from daedalus.learner.run.run_directory import VERSIONS, read_json
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import NoPolicyError, checkpoints, find_policy
from daedalus.policy.saving.sealed import DamagedError


def check_initial(directory: Path | None) -> None:
    """Raise SettingsError if no policy can be read from a directory, that of --init-from; None: there is none."""
    _check(directory, "--init-from: ")


def initial_to_resume(directory: Path) -> Path | None:
    """Return the run whose weights a resumed run still has to begin with, or None.

    A run that was stopped before its first checkpoint begins with them again; versions.json names their run. Raises
    SettingsError if no policy can be read from there.
    """
    if checkpoints(directory) or not (directory / VERSIONS).exists():
        return None
    recorded = read_json(directory / VERSIONS).get("init_from")
    initial = None if recorded is None else Path(recorded)
    _check(initial, f"the run in {directory} has no checkpoint, and begins with the weights of another run, but ")
    return initial


def _check(initial: Path | None, source: str) -> None:
    if initial is not None:
        try:
            find_policy(initial)
        except (DamagedError, NoPolicyError) as error:
            raise SettingsError(f"{source}{error}") from None
