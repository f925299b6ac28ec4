"""Changes of settings when a run is resumed."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from daedalus.learner.run.settings import SettingsError, override, run_spec
from daedalus.protocol.spec import RunSpec

# They define what is learned, and by what: the weights, the statistics of the optimiser and the results so far belong
# to them.
_FIXED_SECTIONS = ("environment.", "policy.")
_FIXED = {"training.algorithm", "training.optimizer", "training.seed", "training.normalize_rewards"}
_CHANGEABLE = {"environment.max_episode_steps", "environment.processes"}


def with_changes(spec: RunSpec, assignments: Sequence[str], directory: Path) -> RunSpec:
    """Return the specification of a run with `section.key=value` assignments applied.

    Raises SettingsError for an invalid assignment, and for settings that cannot change when the run in `directory` is
    resumed.
    """
    settings = spec.model_dump(mode="json", exclude_none=True)
    override(settings, assignments)
    try:
        changed = run_spec(settings)
        fixed = fixed_changes(spec, changed)
    except SettingsError:  # perhaps because others would have to change with a setting that cannot
        fixed = [name for name in _named(assignments) if _is_fixed(name) and name in _values(spec)]
        if not fixed:
            raise
        changed = spec
    if fixed:
        changes = [word for assignment in assignments for word in ("--set", assignment)]
        words = ["daedalus", "train", f"{directory}/config.toml", "--init-from", str(directory), *changes]
        raise SettingsError(
            f"{' and '.join(fixed)} cannot change when a run is resumed: start a new run from the weights of this one, "
            f"such as with: {shlex.join(words)}"
        )
    return changed


def fixed_changes(before: RunSpec, after: RunSpec) -> list[str]:
    """Return the settings that differ and cannot change when a run is resumed, as `section.key`."""
    return [name for name in differing(before, after) if _is_fixed(name)]


def differing(before: RunSpec, after: RunSpec) -> list[str]:
    """Return the settings in which two specifications differ, as `section.key`."""
    old = _values(before)
    return [name for name, value in _values(after).items() if value != old[name]]


def _named(assignments: Sequence[str]) -> list[str]:
    return [assignment.partition("=")[0].strip() for assignment in assignments]


def _is_fixed(name: str) -> bool:
    return name not in _CHANGEABLE and (name in _FIXED or name.startswith(_FIXED_SECTIONS))


def _values(spec: RunSpec) -> dict[str, Any]:
    return {
        f"{section}.{key}": value
        for section, values in spec.model_dump(mode="json").items()
        for key, value in values.items()
    }
