"""Runs in memory: bit-for-bit the same as in several processes, and with gradients from actors."""

import io
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import safetensors.numpy
from processes import LIMIT, Running, until

from daedalus.actor.environments.make import make_environments
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.run import run_directory
from daedalus.learner.run.resuming import Beginning
from daedalus.learner.run.settings import choose_algorithm, override, read_preset, run_spec
from daedalus.learner.service import LearnerService, Outcome, Outputs
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.training.checkpoint import load_newest
from daedalus.protocol import keys
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import STATUS_LIMITS
from daedalus.protocol.messages import StatusReport
from daedalus.protocol.spaces import ComponentOrder, Spaces
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

    def __init__(
        self,
        network: MemoryNetwork,
        spec: RunSpec,
        directory: Path,
        spaces: Spaces | None = None,
        *,
        resume: bool = False,
    ) -> None:
        self.stop, self.rows, self.outcomes = threading.Event(), Rows(), list[Outcome]()
        self._transport = MemoryTransport(network)
        restored = load_newest(directory) if resume else None
        context = RunContext.begin(directory, spec, self.stop, spaces=spaces, restored=restored)
        progress = Progress(io.StringIO(), spec.training.env_steps)
        outputs = Outputs(progress=progress, writers=[lambda: self.rows])
        service = LearnerService(context, self._transport, outputs, Beginning(restored=restored))
        self._thread = threading.Thread(target=lambda: self.outcomes.append(service.run()), daemon=True)
        self._thread.start()

    def join(self) -> Outcome:
        self._thread.join(LIMIT)
        self._transport.close()
        return self.outcomes[0]


@contextmanager
def playing(network: MemoryNetwork, actors: int) -> Iterator[None]:
    """Let actors play, each on a thread, until the block and they end."""
    stop = threading.Event()
    configs = [ActorConfig(name=f"actor-{index}", incarnation=index) for index in range(actors)]
    services = [ActorService(config, MemoryTransport(network), stop) for config in configs]
    threads = [threading.Thread(target=service.run, daemon=True) for service in services]
    try:
        for thread in threads:
            thread.start()
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(LIMIT)
            assert not thread.is_alive()


@pytest.mark.parametrize("algorithm", ["a2c", "a3c"])
def test_a_run_with_gradients_continues_with_another_learner(tmp_path: Path, algorithm: str) -> None:
    settings = read_preset("cartpole")
    choose_algorithm(settings, algorithm)
    changes = ("collection.upload=gradients", "collection.envs_per_actor=16", "training.env_steps=1000000000")
    override(settings, [*changes, "training.normalize_rewards=true", "service.log_seconds=0.05"])
    spec, directory, network = run_spec(settings), tmp_path / "run", MemoryNetwork()
    run_directory.create(directory, spec)
    first = RunningLearner(network, spec, directory)
    with playing(network, 2):
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


SETTINGS = ("training.env_steps=12000", "training.stop_when_solved=false")
NORMALIZATION = (
    "evaluation.final_episodes=0",
    "policy.normalize_observations=true",
    "training.normalize_rewards=true",
    "training.normalize_advantages=true",
)
GRADIENTS = "collection.upload=gradients"


def train_in_one_process(spec: RunSpec, directory: Path, spaces: Spaces | None = None) -> Outcome:
    """Train with learner and actors as threads of this process, over the memory transport."""
    network = MemoryNetwork()
    run_directory.create(directory, spec)
    with playing(network, spec.collection.actors):
        return RunningLearner(network, spec, directory, spaces).join()


def checkpoint_files(directory: Path) -> dict[str, bytes]:
    checkpoint = max((directory / "checkpoints").iterdir())  # a slow run has saved earlier ones
    return {entry.name: entry.read_bytes() for entry in checkpoint.iterdir() if entry.suffix == ".safetensors"}


def test_one_actor_gives_equal_weights_with_rollouts_and_with_gradients(tmp_path: Path) -> None:
    """The actor computes exactly what the learner would, with all running statistics and annealed settings."""
    settings = read_preset("cartpole")
    choose_algorithm(settings, "a2c")
    annealed = ("training.entropy_bonus=0.02", "training.entropy_bonus_final=0.001", "collection.actors=1")
    override(settings, (*SETTINGS, *NORMALIZATION, *annealed))
    train_in_one_process(run_spec(settings), tmp_path / "rollouts")
    override(settings, (GRADIENTS,))
    train_in_one_process(run_spec(settings), tmp_path / "gradients")
    equal = checkpoint_files(tmp_path / "rollouts")
    assert checkpoint_files(tmp_path / "gradients") == equal
    override(settings, ("training.seed=2",))  # the tests of this file can fail: the weights depend on the seed
    train_in_one_process(run_spec(settings), tmp_path / "other")
    assert checkpoint_files(tmp_path / "other") != equal


class TwoParts(gymnasium.Env):
    """Two observed numbers of which the reward depends on one, listed against the order of their names."""

    observation_space = gymnasium.spaces.Dict(
        OrderedDict((name, gymnasium.spaces.Box(-1.0, 1.0, (1,))) for name in ("second", "first"))
    )
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: int) -> Any:
        reward = float((self._observed["first"][0] > 0) == action)
        return self._observe(), reward, bool(self.np_random.random() < 0.1), False, {}

    def _observe(self) -> dict[str, Any]:
        first, second = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
        self._observed = {"second": second[None], "first": first[None]}
        return self._observed


def test_an_actor_that_builds_the_network_reads_the_components_in_the_learners_order(tmp_path: Path) -> None:
    gymnasium.register("TwoParts-v0", lambda **_: TwoParts(), max_episode_steps=100)
    try:
        settings = {"environment": {"id": "TwoParts-v0"}, "training": {"algorithm": "a2c", "env_steps": 3000}}
        override(settings, ("collection.actors=1", "evaluation.final_episodes=0"))
        with closing(make_environments(run_spec(settings).environment, 1)) as environments:
            here = environments.spaces
        assert here.order == ComponentOrder(observations=(1, 0), actions=(0,))
        there = here.in_order(ComponentOrder(observations=(0, 1), actions=(0,)))
        assert [*there.observations] == ["first", "second"]
        train_in_one_process(run_spec(settings), tmp_path / "rollouts", there)
        override(settings, (GRADIENTS,))
        train_in_one_process(run_spec(settings), tmp_path / "gradients", there)
    finally:
        gymnasium.registry.pop("TwoParts-v0")
    with_rollouts, with_gradients = (
        safetensors.numpy.load(checkpoint_files(tmp_path / upload)["parameters.safetensors"])
        for upload in ("rollouts", "gradients")
    )
    for name, weights in with_rollouts.items():
        np.testing.assert_allclose(with_gradients[name], weights, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("change", ["training.curiosity=0.5", GRADIENTS], ids=["rollouts", "gradients"])
def test_a2c_gives_bit_for_bit_equal_weights_in_one_process_and_in_several(
    start: Callable[..., Running], tmp_path: Path, change: str
) -> None:
    settings, changes = read_preset("cartpole"), (*NORMALIZATION, change)
    choose_algorithm(settings, "a2c")
    override(settings, (*SETTINGS, *changes))
    assert train_in_one_process(run_spec(settings), tmp_path / "one").finished
    words = [word for setting in (*SETTINGS, *changes) for word in ("--set", setting)]
    running = start("train", "cartpole", "--algorithm", "a2c", *words, "--run-dir", "many")
    assert running.wait() == 0, running.output
    one, many = checkpoint_files(tmp_path / "one"), checkpoint_files(tmp_path / "many")
    assert one.keys() == {"parameters.safetensors", "learner.safetensors"}
    assert one == many
    state = safetensors.numpy.load(one["learner.safetensors"])
    counts = [float(values.min()) for name, values in state.items() if name.endswith("/count")]
    env_steps = json.loads((tmp_path / "many" / "summary.json").read_text())["env_steps"]
    assert counts == [env_steps] * (2 if change == GRADIENTS else 3)  # each env_step counts once; reset rows do not


def test_a2c_gives_bit_for_bit_equal_weights_of_a_policy_that_plays_itself(tmp_path: Path) -> None:
    """Without opponents, whose versions come when they come, the rows of a game depend on the seed alone."""
    alone = {"past_share": 0.0, "rating_share": 0.0, "opponents": {}}
    settings = {
        "environment": {"id": "pettingzoo.classic.tictactoe_v3"},
        "collection": {"actors": 2, "envs_per_actor": 3, "rollout_length": 20},
        "training": {"algorithm": "a2c", "env_steps": 800, "stop_when_solved": False},
        "league": alone,
    }
    assert train_in_one_process(run_spec(settings), tmp_path / "one").finished
    assert train_in_one_process(run_spec(settings), tmp_path / "two").finished
    assert checkpoint_files(tmp_path / "one") == checkpoint_files(tmp_path / "two")
