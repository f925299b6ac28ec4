"""The run whose weights a new run begins with."""

from pathlib import Path

from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import NoPolicyError, find_policy
from daedalus.policy.saving.sealed import DamagedError


def check_initial(directory: Path | None) -> None:
    """Raise SettingsError if no policy can be read from a directory, that of --init-from; None: there is none."""
    if directory is not None:
        try:
            find_policy(directory)
        except (DamagedError, NoPolicyError) as error:
            raise SettingsError(f"--init-from: {error}") from None
