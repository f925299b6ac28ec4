"""A run whose actors upload gradients: metrics, episodes, a checkpoint, a learner that is replaced. In memory."""

import io
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from processes import LIMIT, until

from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.learner.reporting.metrics import Details
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import choose_algorithm, override, read_preset, run_spec
from daedalus.learner.service import LearnerService, Outcome
from daedalus.learner.training.checkpoint import load_newest
from daedalus.protocol import keys
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import STATUS_LIMITS
from daedalus.protocol.messages import StatusReport
from daedalus.protocol.spec import RunSpec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class Rows:
    """Metrics writer that keeps the rows."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []

    def write(self, row: Mapping[str, float], details: Details) -> None:
        self.rows.append(dict(row))

    def close(self) -> None:
        pass


class RunningLearner:
    """A learner on a thread."""

    def __init__(self, network: MemoryNetwork, spec: RunSpec, directory: Path, *, resume: bool = False) -> None:
        self.stop, self.rows, self.outcomes = threading.Event(), Rows(), list[Outcome]()
        self._transport = MemoryTransport(network)
        service = LearnerService(
            spec,
            directory,
            self._transport,
            self.stop,
            Progress(io.StringIO(), spec.training.env_steps),
            [lambda: self.rows],
            started=0.0,
            restored=load_newest(directory) if resume else None,
        )
        self._thread = threading.Thread(target=lambda: self.outcomes.append(service.run()), daemon=True)
        self._thread.start()

    def join(self) -> Outcome:
        self._thread.join(LIMIT)
        self._transport.close()
        return self.outcomes[0]


@pytest.mark.parametrize("algorithm", ["a2c", "a3c"])
def test_a_run_with_gradients_continues_with_another_learner(tmp_path: Path, algorithm: str) -> None:
    settings = read_preset("cartpole")
    choose_algorithm(settings, algorithm)
    changes: list[Any] = [
        "collection.upload=gradients",
        "collection.envs_per_actor=16",
        "training.env_steps=1000000000",
    ]
    override(settings, [*changes, "training.normalize_rewards=true", "service.log_seconds=0.05"])
    spec, directory, network = run_spec(settings), tmp_path / "run", MemoryNetwork()
    run_directory.create(directory, spec)
    stop = threading.Event()
    configs = [ActorConfig(name=f"a{index}", incarnation=index) for index in (0, 1)]
    actors = [ActorService(config, MemoryTransport(network), stop) for config in configs]
    threads = [threading.Thread(target=actor.run, daemon=True) for actor in actors]
    try:
        first = RunningLearner(network, spec, directory)
        for thread in threads:
            thread.start()
        until(lambda: any(row["env_steps"] > 500 for row in first.rows.rows))
        (answer,) = MemoryTransport(network).query(keys.status("run"), timeout=LIMIT)
        report = decode(answer, STATUS_LIMITS)
        assert isinstance(report, StatusReport)
        assert {actor.actor for actor in report.status.actors if actor.env_steps and actor.rollouts_accepted}
        first.stop.set()
        assert not first.join().finished
        env_steps = first.rows.rows[-1]["env_steps"]
        budget = int(env_steps) + 3000
        training = spec.training.model_copy(update={"env_steps": budget})
        second = RunningLearner(network, spec.model_copy(update={"training": training}), directory, resume=True)
        assert second.join().finished
    finally:
        stop.set()
        for thread in threads:
            thread.join(LIMIT)
    assert second.rows.rows[0]["env_steps"] >= env_steps
    last = second.rows.rows[-1]
    assert last["env_steps"] >= budget
    assert last["episodes"] > 0
    measured = {name for row in second.rows.rows for name in row}
    assert {"policy_loss", "entropy", "explained_variance", "gradient_norm", "value_error_p50"} <= measured
    counters = load_newest(directory).counters
    assert counters["env_steps"] == last["env_steps"]
    returns = load_newest(directory).state["returns/count"]
    assert returns == counters["env_steps"]  # each valid row of both learners counts once
