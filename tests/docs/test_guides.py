"""The examples of the guides work as they are printed."""

import importlib
import json
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from allowed_modules import TEST_MODULES
from browser import Visit, chromium
from building import SPACES, make_rollouts
from pages import DOCS, ROOT, code_blocks
from plain import PlainEnvironments, act, choices, plain_spaces
from recorded_runs import record
from saved_runs import CARTPOLE, save

import daedalus
from daedalus.actor.checking.play import check_environment
from daedalus.actor.environments.bots import make_bot
from daedalus.actor.environments.make import make_environments
from daedalus.algorithms.losses import shares_of
from daedalus.launch.callbacks import TrainingRun
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.run_choice import with_record
from daedalus.launch.tracker_processes import TrackerProcesses
from daedalus.learner.reporting.trackers.tracker import tracker_name
from daedalus.learner.run.settings import choose_algorithm, read_settings, run_spec
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import ArraySpace
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, TrainingSpec


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A reader's working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def example(guide: str, language: str = "python", number: int = 0) -> str:
    return code_blocks((DOCS / "guides" / guide).read_text("utf-8"), language)[number]


def test_the_environment_can_be_played(folder: Path) -> None:
    (folder / "corridor.py").write_text(example("environment.md"))
    (folder / "corridor_wrappers.py").write_text(example("environment.md", number=2))
    spec = EnvironmentSpec(id="corridor:Corridor-v0", kwargs={"cells": 8}, wrap="corridor_wrappers:step_costs")
    environments = PlainEnvironments(make_environments(spec, 2, modules=TEST_MODULES))
    assert choices(environments.spaces) == 2
    environments.reset(0)
    steps = [environments.step(np.array([1, 0])) for _ in range(8)]
    assert steps[-1][1].tolist() == [0.99, -0.01]
    assert steps[-1][2].tolist() == [True, False]
    environments.close()


def test_an_exported_policy_plays_with_onnxruntime_alone(folder: Path) -> None:
    save(folder / "run", CARTPOLE, 1)
    save(folder / "stacked", CARTPOLE.model_copy(update={"frame_stack": 3}), 1, policy={"memory": "gru"})
    daedalus.load_policy("run").export("cartpole.onnx")
    code = example("export.md")
    assert len([line for line in code.splitlines() if line]) <= 10
    played: dict[str, Any] = {}
    exec(code, played)
    assert played["ended"]
    policy = daedalus.load_policy("stacked")
    policy.export("policy.onnx")
    remembering: dict[str, Any] = {}
    exec(example("export.md", number=1), remembering)
    state = remembering["start"]
    for observation in np.random.default_rng(1).normal(size=(20, 4)).astype(np.float32):
        action, state = remembering["act"](observation, state)
        assert action == policy.act(observation)


def test_an_exported_policy_plays_in_a_browser(folder: Path) -> None:
    packages = ROOT / "tests" / "gateway" / "node_modules"
    if not (packages / "onnxruntime-web").is_dir():
        pytest.skip("onnxruntime-web is not installed: run `make examples`")
    policy = daedalus.load_policy(save(folder / "run", CARTPOLE, 1))
    policy.export("cartpole.onnx")
    (folder / "page.html").write_text('<link rel="icon" href="data:,">' + example("export.md", "html"))
    (folder / "node_modules").symlink_to(packages)
    handler = partial(QuietHandler, directory=folder)
    with chromium() as browser, ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        visit = Visit(browser, f"http://127.0.0.1:{server.server_port}/page.html")
        try:
            visit.page.wait_for_function("document.title.startsWith('action')")
            expected = policy.act(np.array([0, 0, 0.05, 0], np.float32))
            assert visit.page.title() == f"action {expected}"
            assert (visit.complaints, visit.strange_requests) == ([], [])
        finally:
            visit.close()
            server.shutdown()


class QuietHandler(SimpleHTTPRequestHandler):
    """A web server that logs nothing."""

    def log_message(self, format: str, *args: Any) -> None:
        pass


def test_the_game_can_be_played(folder: Path) -> None:
    (folder / "meeting.py").write_text(example("several_agents.md"))
    spec = EnvironmentSpec(id="meeting:Meeting", backend="pettingzoo")
    report = check_environment(spec, UserModules(frozenset({"meeting"})), seconds=30.0, env_steps=500)
    assert (report.problems, report.warnings) == ((), ())
    assert max(report.lengths) == 40
    assert -2.01 < min(report.returns) < 0.0 < max(report.returns) <= 1.0


def test_the_game_of_self_play_can_be_played_by_the_bot(folder: Path) -> None:
    code = example("self_play.md")
    assert len([line for line in code.splitlines() if line]) <= 40
    (folder / "rps.py").write_text(code)
    (folder / "rps_bots.py").write_text(example("self_play.md", number=1))
    modules = UserModules(frozenset({"rps", "rps_bots"}))
    report = check_environment(
        EnvironmentSpec(id="rps:RockPaperScissors", backend="pettingzoo"), modules, seconds=30.0, env_steps=200
    )
    assert (report.problems, report.warnings) == ((), ())
    assert set(report.lengths) == {10}
    game = importlib.import_module("rps").RockPaperScissors()
    seen, _ = game.reset()
    bot = make_bot("rps_bots:Copycat", game.action_space("second"), modules)
    bot.reset("second", 1)
    won = []
    while game.agents:  # against paper again and again
        seen, rewards, *_ = game.step({"first": 1, "second": bot.act(seen["second"], None)})
        won.append(rewards["second"])
    assert won[1:] == [1.0] * 9


def test_the_readmes_environment_of_one_s_own_works_as_it_is_pasted(folder: Path) -> None:
    code = code_blocks((ROOT / "README.md").read_text("utf-8"), "python")[0]
    assert len([line for line in code.splitlines() if line]) <= 12
    (folder / "hallway.py").write_text(code)
    spec = EnvironmentSpec(id="hallway:Hallway-v0")
    modules = UserModules(frozenset({"hallway"}))
    report = check_environment(spec, modules, seconds=10.0, env_steps=500)
    assert (report.problems, report.warnings) == ((), ())
    assert 1.0 in report.returns  # random actions reach the end now and then


def test_the_settings_of_stable_baselines3_are_a_run(folder: Path) -> None:
    (folder / "ppo.toml").write_text(example("stable_baselines3.md", "toml"))
    spec = run_spec(read_settings(folder / "ppo.toml"))
    rows = spec.batch_rollouts * spec.collection.rollout_length * spec.collection.envs_per_actor
    assert rows == 16 * 1024  # n_envs x n_steps
    assert rows // spec.training.minibatches == 512  # batch_size


def test_the_preset_is_a_run(folder: Path) -> None:
    (folder / "corridor.toml").write_text(example("environment.md", "toml"))
    settings = read_settings(folder / "corridor.toml")
    choose_algorithm(settings, "a3c")
    assert run_spec(settings).training.learning_rate == 3e-4


def test_the_network_becomes_a_program(folder: Path) -> None:
    (folder / "my_network.py").write_text(example("network.md"))
    spaces = plain_spaces(ArraySpace(shape=(12, 12), dtype="uint8", frames=3), 4)
    learner = Learner(
        TrainingSpec(), PolicySpec(encoder="my_network:Encoder"), spaces, UserModules(frozenset({"my_network"}))
    )
    runtime = OnnxRuntime(learner.program())
    runtime.load(learner.weights())
    observations = np.full((5, 3, 12, 12), 255, np.uint8)
    actions = act(runtime, observations, np.zeros((5, 0), np.float32), np.random.default_rng(0))[0]
    assert actions.shape == (5,)


def test_the_algorithm_learns(folder: Path) -> None:
    code = example("algorithm.md")
    assert len(code.splitlines()) <= 60
    (folder / "my_module.py").write_text(code)
    modules = UserModules(frozenset({"my_module"}))
    training = {"algorithm": "my_module:KlPenalty", "algorithm_kwargs": {"penalty": 1e3}}
    spec = with_record(run_spec({"environment": {"id": "Any-v0"}, "training": training}), modules)
    assert spec.algorithm.corrected
    learner = Learner(spec.training, PolicySpec(hidden=(8,)), SPACES, modules)
    before = {name: values.copy() for name, values in learner.weights().items()}
    assert learner.step(make_rollouts(1), 0.0) == []
    assert learner.metrics.take_means()["policy_loss"] > 10.0  # the KL to random log-probabilities, a thousand times
    assert not np.array_equal(learner.weights()["policy_head.weight"], before["policy_head.weight"])


def test_the_value_loss_of_the_clipped_algorithm_is_that_of_the_paper(folder: Path) -> None:
    """Engstrom et al. (2020), section 3, row by row. Where the clipped error is the worse one, there is no gradient."""
    (folder / "my_ppo.py").write_text(example("algorithm.md", number=1))
    modules = UserModules(frozenset({"my_ppo"}))
    training = {"algorithm": "my_ppo:ValueClipped", "algorithm_kwargs": {"value_clip": 0.5}, "passes": 2}
    spec = with_record(run_spec({"environment": {"id": "Any-v0"}, "training": training}), modules).training
    learner = Learner(spec, PolicySpec(hidden=(8,)), SPACES, modules)
    before = {name: values.copy() for name, values in learner.weights().items()}
    assert learner.step(make_rollouts(1), 0.0) == []
    assert learner.metrics.take_means()["value_loss"] > 0.0
    assert not np.array_equal(learner.weights()["value_head.weight"], before["value_head.weight"])

    class Rows(NamedTuple):
        values: torch.Tensor
        targets: torch.Tensor
        shares: torch.Tensor

    generator = torch.Generator().manual_seed(1)
    old, new, targets = (torch.randn(1, 200, generator=generator) for _ in range(3))
    new.requires_grad_()
    counted = torch.arange(200) % 3 != 0
    algorithm = importlib.import_module("my_ppo").ValueClipped(spec, None, 0.5)
    loss = algorithm.value_loss(Rows(old, targets, shares_of(counted.float().unsqueeze(0))), new)
    loss.backward()
    errors, moving = [], []
    for v, v_old, g in zip(new[0].tolist(), old[0].tolist(), targets[0].tolist(), strict=True):
        clipped = min(max(v, v_old - 0.5), v_old + 0.5)
        errors.append(max((v - g) ** 2, (clipped - g) ** 2))
        moving.append((v - g) ** 2 >= (clipped - g) ** 2)
    expected = [error for error, counts in zip(errors, counted.tolist(), strict=True) if counts]
    assert loss.item() == pytest.approx(sum(expected) / len(expected), rel=1e-5)
    assert new.grad is not None
    assert ((new.grad[0] != 0.0) == (torch.tensor(moving) & counted)).all()
    assert 20 < (torch.tensor(moving) & counted).sum() < counted.sum() - 20  # both errors were the worse one


def test_the_algorithm_of_action_values_learns(folder: Path) -> None:
    (folder / "my_values.py").write_text(example("algorithm.md", number=2))
    modules = UserModules(frozenset({"my_values"}))
    spec = run_spec({"environment": {"id": "Any-v0"}, "training": {"algorithm": "my_values:DoubleQ"}})
    spec = with_record(spec, modules)
    assert spec.training.epsilons == (0.1, 0.01)
    learner = Learner(spec.training, PolicySpec(hidden=(8,)), SPACES, modules)
    weights, target = learner.weights()["policy_head.weight"], learner.state()["target_network"].clone()
    before = weights.copy()
    assert learner.step(make_rollouts(1), 0.0) == []
    assert not np.array_equal(weights, before)
    followed = (learner.state()["target_network"] - target).abs().max()
    assert 0.0 < followed < 0.02 * np.abs(weights - before).max()
    assert OnnxRuntime(learner.program()).explores


def test_the_metrics_writer_writes(folder: Path) -> None:
    (folder / "my_writer.py").write_text(example("metrics_writer.md"))
    directory, lines = record(folder / "run"), list[str]()
    with ChildOutput(directory / "output.log", lines.append, lines.append) as output:
        trackers = TrackerProcesses([tracker_name("my_writer:JsonLines")], directory, output)
        trackers.start()
        trackers.finish(threading.Event())
    assert lines == ["my_writer:JsonLines: metrics go to my_writer:JsonLines"]
    rows = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    assert [row["env_steps"] for row in rows] == [1000, 2000, 3000]
    assert rows[1]["episode_return_mean"] == 300.0


def test_the_callback_ends_training_on_a_plateau(folder: Path) -> None:
    (folder / "plateau.py").write_text(example("callback.md"))
    sys.path.append(str(folder))
    callback = importlib.import_module("plateau").StopOnPlateau(100)
    run = TrainingRun(folder)
    for env_steps, mean in ((0, None), (100, 20.0), (150, 30.0), (200, 10.0)):
        callback.on_metrics(run, {"env_steps": env_steps, **({} if mean is None else {"episode_return_mean": mean})})
    assert run.stop_reason is None
    callback.on_metrics(run, {"env_steps": 250, "episode_return_mean": 29.0})
    assert run.stop_reason == "no better mean return than 30.0 for 100 env_steps"
    assert run.take_metrics() == {"best_return": 30.0}
