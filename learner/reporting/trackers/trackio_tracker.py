"""Tracker for Trackio."""

import os
import secrets
from collections.abc import Mapping
from typing import Any

from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.trackers.tracker import PROJECT, SUMMARY, TrackedRun, tagged


class TrackioTracker:
    """Run in Trackio's local database, or at the Space of TRACKIO_SPACE_ID."""

    def __init__(self, run: TrackedRun) -> None:
        import trackio  # pyright: ignore[reportMissingImports]  # takes seconds

        # Trackio finds a run by its name. Two run directories may have the same name.
        self.id = run.id or f"{run.name}-{secrets.token_hex(2)}"
        project = os.environ.get("TRACKIO_PROJECT", PROJECT)
        self._run = trackio.init(project=project, name=self.id, config=dict(run.settings), resume="allow")
        self._env_steps = 0
        self.place = f"run {self.id}; show it with: trackio show --project {project}"

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """See Tracker."""
        self._env_steps = int(row["env_steps"])
        self._run.log(tagged(row), step=self._env_steps)

    def summarize(self, summary: Mapping[str, Any]) -> None:
        """See Tracker."""
        self._run.log({SUMMARY + name: value for name, value in summary.items()}, step=self._env_steps)

    def close(self) -> None:
        """See MetricsWriter."""
        self._run.finish()
