"""Tracker for MLflow. It uses the client, whose calls raise exceptions, and none of MLflow's global state."""

import os
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from typing import Any

from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.trackers.tracker import PROJECT, SUMMARY, TrackedRun, flat, tagged
from daedalus.protocol.texts import without_secrets

# MLflow's own defaults make a call to a server that does not answer last for many minutes.
_HTTP = {"MLFLOW_HTTP_REQUEST_TIMEOUT": "20", "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1"}
_PARAMETERS_A_CALL = 100  # limit of MLflow
_LONGEST_NAME = 250  # characters; limit of MLflow
_LONGEST = 5000  # characters of a value; MLflow's limit is 6000 for parameters and 8000 for tags


class MlflowTracker:
    """Run at the tracking server of MLFLOW_TRACKING_URI, or in MLflow's local database (mlflow.db).

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
