"""The file confirmation.json of a run directory: the learner asks its launcher whether a reached target is confirmed.

The learner writes the policy version of its newest checkpoint, and waits. The launcher plays new episodes with that
checkpoint, and adds the result.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

from daedalus.learner.run.run_directory import CONFIRMATION, read_json, write_json
from daedalus.learner.run.settings import SettingsError


class ConfirmationFile:
    """The file of one run, for both sides."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / CONFIRMATION

    def ask(self, policy_version: int) -> None:
        """Ask for a confirmation of this policy version. Raises OSError."""
        write_json(self._path, {"policy_version": policy_version, "result": None})

    def asked(self) -> int | None:
        """Return the policy version that waits for its confirmation, or None."""
        content = self._read()
        return content.get("policy_version") if content.get("result") is None else None

    def answer(self, policy_version: int, result: dict[str, Any]) -> None:
        """Add the result for a policy version. `result["confirmed"]` is the decision. Raises OSError."""
        write_json(self._path, {"policy_version": policy_version, "result": result})

    def answered(self, policy_version: int) -> dict[str, Any] | None:
        """Return the result for a policy version, or None if there is none yet."""
        content = self._read()
        return content.get("result") if content.get("policy_version") == policy_version else None

    def clear(self) -> None:
        """Remove the file."""
        with suppress(OSError):
            self._path.unlink()

    def _read(self) -> dict[str, Any]:
        with suppress(SettingsError):
            return read_json(self._path)
        return {}
