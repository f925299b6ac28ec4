"""Trackers for Weights & Biases, MLflow and Trackio. Each imports its package when it is opened."""

import os
import re
import secrets
import time
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from typing import Any

from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.trackers.tracker import PROJECT, SUMMARY, TrackedRun, flat, tagged
from daedalus.policy.user_code import message_line
from daedalus.protocol.texts import without_secrets

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


# MLflow's own defaults make a call to a server that does not answer last for many minutes.
_HTTP = {"MLFLOW_HTTP_REQUEST_TIMEOUT": "20", "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1"}
_PARAMETERS_A_CALL = 100  # limit of MLflow
_LONGEST_NAME = 250  # characters; limit of MLflow
_LONGEST = 5000  # characters of a value; MLflow's limit is 6000 for parameters and 8000 for tags


class MlflowTracker:
    """Run at the tracking server of MLFLOW_TRACKING_URI, or in MLflow's local database (mlflow.db).

    It uses the client, whose calls raise exceptions, and none of MLflow's global state.

    Parameters are the settings at the first start. Settings that `daedalus resume` changes become tags, because MLflow
    does not allow other values for parameters.
    """

    def __init__(self, run: TrackedRun) -> None:
        for name, value in _HTTP.items():
            os.environ.setdefault(name, value)
        from mlflow import MlflowClient  # takes seconds
        from mlflow.entities import Metric, Param, RunTag

        self._metric, self._tag = Metric, RunTag
        self._client = MlflowClient()
        self._env_steps = 0
        known = self._known(run.id)
        settings = {_parameter_name(name): str(value)[:_LONGEST] for name, value in flat(run.settings)}
        if known is None:
            self.id = self._client.create_run(self._experiment(), run_name=run.name).info.run_id
            try:
                parameters = iter([Param(name, value) for name, value in settings.items()])
                while some := list(islice(parameters, _PARAMETERS_A_CALL)):
                    self._client.log_batch(self.id, params=some)
            except Exception:
                with suppress(Exception):  # the tracker is opened again, and would leave this run behind
                    self._client.delete_run(self.id)
                raise
        else:
            self.id = run.id
            self._client.update_run(self.id, status="RUNNING")
            changed = {name: value for name, value in settings.items() if known.data.params.get(name) != value}
            self._client.log_batch(self.id, tags=[RunTag(f"resumed.{name}", value) for name, value in changed.items()])
        address = without_secrets(self._client.tracking_uri)
        self.place = f"run {run.name} ({self.id}) at {address}"

    def _known(self, id: str) -> Any:
        """Return the run with an id, or None if the server has none."""
        from mlflow.exceptions import MlflowException

        if not id:
            return None
        try:
            return self._client.get_run(id)
        except MlflowException as error:
            if error.error_code == "RESOURCE_DOES_NOT_EXIST":
                return None
            raise

    def _experiment(self) -> str:
        """Return the id of the experiment, which is created if it is missing."""
        from mlflow.exceptions import MlflowException

        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        found = self._client.get_experiment_by_name(name)
        if found is None:
            try:
                return self._client.create_experiment(name)
            except MlflowException:  # another run has created it since
                found = self._client.get_experiment_by_name(name)
                if found is None:
                    raise
        return found.experiment_id

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """See Tracker."""
        self._env_steps = int(row["env_steps"])
        self._client.log_batch(self.id, metrics=self._metrics(tagged(row)))

    def summarize(self, summary: Mapping[str, Any]) -> None:
        """See Tracker."""
        numbers = {SUMMARY + name: float(value) for name, value in summary.items() if isinstance(value, int | float)}
        texts = {SUMMARY + name: value for name, value in summary.items() if isinstance(value, str)}
        tags = [self._tag(name, value[:_LONGEST]) for name, value in texts.items()]
        self._client.log_batch(self.id, metrics=self._metrics(numbers), tags=tags)

    def _metrics(self, values: Mapping[str, float]) -> list[Any]:
        now = int(time.time() * 1000)
        return [self._metric(name, value, now, self._env_steps) for name, value in values.items()]

    def close(self) -> None:
        """See MetricsWriter."""
        self._client.set_terminated(self.id)


def _parameter_name(setting: str) -> str:
    """Return a name of characters that MLflow takes. Arguments of an environment may have any names."""
    return re.sub(r"[^\w.\- :]", "_", setting)[:_LONGEST_NAME]


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
