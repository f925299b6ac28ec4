"""Tracker for Weights & Biases."""

import os
import secrets
from collections.abc import Mapping
from typing import Any

from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.trackers.tracker import PROJECT, SUMMARY, TrackedRun, tagged
from daedalus.policy.user_code import message_line

_INIT_SECONDS = 30.0  # for the server to answer


class WandbTracker:
    """Run at Weights & Biases, or in its local files if the user is not logged in or the server does not answer.

    Steps are env_steps. Weights & Biases drops a row with fewer steps than the row before.
    """

    def __init__(self, run: TrackedRun) -> None:
        os.environ.setdefault("WANDB_PROJECT", PROJECT)
        import wandb  # takes a second
        from wandb.errors import Error

        def begin(mode: Any) -> Any:
            return wandb.init(
                id=self.id,
                name=os.environ.get("WANDB_NAME", run.name),
                resume="allow",
                dir=os.environ.get("WANDB_DIR", str(run.directory)),
                config=dict(run.settings),
                allow_val_change=True,  # `daedalus resume --set` changes settings
                mode=mode,
                settings=wandb.Settings(silent=True, console="off", init_timeout=_INIT_SECONDS),
            )

        self.id = run.id or os.environ.get("WANDB_RUN_ID") or secrets.token_hex(4)
        fault = ""
        try:
            self._run = begin(None)  # WANDB_MODE, or online
        except Error as error:
            fault = f"{message_line(error).rstrip('.')}; "
            self._run = begin("offline")
        if self._run.offline:
            self.place = f"{fault}recorded offline; upload the run with: wandb sync {self._run.settings.sync_dir}"
        else:
            self.place = self._run.url or "disabled"

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """See Tracker."""
        self._run.log(tagged(row), step=int(row["env_steps"]))

    def summarize(self, summary: Mapping[str, Any]) -> None:
        """See Tracker."""
        self._run.summary.update({SUMMARY + name: value for name, value in summary.items()})

    def close(self) -> None:
        """See MetricsWriter."""
        self._run.finish()
