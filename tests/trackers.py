"""What trackers have recorded in their local files, without a server."""

import json
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def wandb_records(run: Path) -> list[Any]:
    """Return the records of an offline run of Weights & Biases: LevelDB's log format, with protobuf messages."""
    from wandb.proto import wandb_internal_pb2

    record = vars(wandb_internal_pb2)["Record"]  # made at import, so a type checker cannot find it
    return [record.FromString(data) for data in _log_records(run.read_bytes())]


def _log_records(data: bytes) -> Iterator[bytes]:
    at, whole, block = 7, b"", 1 << 15
    while at + 7 <= len(data):
        if block - at % block < 7:
            at += block - at % block
            continue
        _, length, kind = struct.unpack("<IHB", data[at : at + 7])
        whole, at = whole + data[at + 7 : at + 7 + length], at + 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield whole
            whole = b""


def wandb_run(directory: Path) -> dict[str, Any]:
    """Return id, config, history (metrics by step) and summary of the newest offline run in a folder."""
    newest = max(directory.glob("wandb/offline-run-*/run-*.wandb"), key=lambda path: path.stat().st_mtime)
    run: dict[str, Any] = {"history": {}, "summary": {}}
    for record in wandb_records(newest):
        if record.HasField("run"):
            run["id"] = record.run.run_id
            run["config"] = {item.key: json.loads(item.value_json) for item in record.run.config.update}
        elif record.HasField("history"):
            row = {".".join(item.nested_key) or item.key: json.loads(item.value_json) for item in record.history.item}
            run["history"][row["_step"]] = row
        elif record.HasField("summary"):
            run["summary"] |= {item.key: json.loads(item.value_json) for item in record.summary.update if item.key}
    return run


def mlflow_run(database: Path) -> dict[str, Any]:
    """Return id, config, history and summary of the only run in MLflow's database."""
    with sqlite3.connect(database) as tables:
        ((run, status),) = tables.execute("select run_uuid, status from runs").fetchall()
        history: dict[int, dict[str, float]] = {}
        for step, key, value in tables.execute("select step, key, value from metrics order by step"):
            history.setdefault(step, {})[key] = value
        config = dict(tables.execute("select key, value from params").fetchall())
        tags = dict(tables.execute("select key, value from tags").fetchall())
    tables.close()
    summary = {key: value for row in history.values() for key, value in row.items() if key.startswith("summary/")}
    return {"id": run, "status": status, "config": config, "history": history, "summary": {**summary, **tags}}


def trackio_run(database: Path) -> dict[str, Any]:
    """Return id, config, history and summary of the only run in Trackio's database."""
    with sqlite3.connect(database) as tables:
        rows = tables.execute("select run_name, step, metrics from metrics order by id").fetchall()
        ((config,),) = tables.execute("select config from configs").fetchall()
    tables.close()
    (run,) = {name for name, _, _ in rows}
    history: dict[int, dict[str, Any]] = {}
    for _, step, metrics in rows:
        history.setdefault(step, {}).update(json.loads(metrics))
    summary = {key: value for row in history.values() for key, value in row.items() if key.startswith("summary/")}
    return {"id": run, "config": json.loads(config), "history": history, "summary": summary}
