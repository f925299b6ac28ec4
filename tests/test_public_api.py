"""Test of the public API: `import daedalus`, `daedalus.train` and `daedalus.load_policy`."""

import ast
import inspect
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import gymnasium
import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from processes import LIMIT, Running, processes_mentioning, until
from recorded_runs import record
from saved_runs import CARTPOLE, COUNTING, save

import daedalus
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.episodes import play_episodes
from daedalus.cli.commands.evaluate import main as evaluate_command
from daedalus.launch import train_function
from daedalus.launch.local_run import LocalRun, RunFailedError
from daedalus.learner.run.run_directory import create
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyError
from daedalus.policy.saving.saved_policy import find_policy, pretrained
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

BUDGET = {"env_steps": 5_000, "actors": 1, "settings": {"evaluation.final_episodes": 0, "policy.hidden": [16]}}


def test_importing_daedalus_loads_no_other_package() -> None:
    program = "import sys; before = set(sys.modules); import daedalus; print(*sys.modules.keys() - before)"
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    loaded = set(output.split()) - {"daedalus"}
    assert {name.partition(".")[0] for name in loaded} <= sys.stdlib_module_names


@pytest.mark.parametrize("name", daedalus.__all__)
def test_each_public_name_is_documented_and_declared_for_type_checkers(name: str) -> None:
    value = getattr(daedalus, name)
    assert name in dir(daedalus)
    if name != "__version__":
        assert inspect.getdoc(value)
    (declared,) = [node for node in ast.parse(inspect.getsource(daedalus)).body if isinstance(node, ast.If)]
    names = {alias.name for node in declared.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert name in names | {"__version__"}


def test_the_version_is_that_of_the_distribution() -> None:
    assert daedalus.__version__ == version("daedalus-rl")


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Clinet'"):
        daedalus.Clinet  # type: ignore[attr-defined]  # noqa: B018


# ------------------------------------------------------------------------------------------------ train


def test_train_in_another_thread_calls_its_callback_and_returns_the_result(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    class Watch(daedalus.Callback):
        calls: ClassVar[list[str]] = []

        def on_start(self, run: daedalus.TrainingRun) -> None:
            self.calls.append("start")

        def on_metrics(self, run: daedalus.TrainingRun, row: Mapping[str, float]) -> None:
            self.calls.append("row")
            run.log({"twice": 2 * row["env_steps"]})
            if row.get("user/twice"):  # not 0: there are env_steps
                run.stop("it came back")

        def on_end(self, run: daedalus.TrainingRun) -> None:
            self.calls.append("end")

    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    results: list[daedalus.RunResult] = []
    directory = tmp_path / "from-a-thread"
    settings = {**BUDGET["settings"], "service.log_seconds": 0.1}
    arguments = {"env_steps": 10**9, "actors": 1, "run_dir": str(directory), "quiet": True, "settings": settings}
    arguments |= {"seed": 3, "callback": Watch()}
    thread = threading.Thread(target=lambda: results.append(daedalus.train(env="CartPole-v1", **arguments)))
    thread.start()
    thread.join()
    (result,) = results
    summary = json.loads((directory / "summary.json").read_text())
    assert (result.directory, result.exit_status, result.stop_reason) == (directory, 0, "it came back")
    assert (result.solved, result.finished) == (False, False)
    assert result.env_steps == summary["env_steps"] > 0
    assert (result.evaluation_return_mean, summary["evaluation_return_mean"]) == (None, None)
    assert result.summary == summary
    assert (summary["seed"], summary["algorithm"]) == (3, "appo")
    assert capfd.readouterr() == ("", "")
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == handlers
    assert not processes_mentioning("from-a-thread")
    policy = daedalus.load_policy(directory)
    assert policy.policy_version == result.updates
    assert (Watch.calls[0], Watch.calls[-1]) == ("start", "end")
    assert set(Watch.calls[1:-1]) == {"row"}
    assert "user/twice" in (directory / "metrics.csv").read_text().splitlines()[0]


def test_a_failed_train_raises_the_error_of_the_process(tmp_path: Path) -> None:
    with pytest.raises(daedalus.TrainingError) as failed:
        daedalus.train(env="CartPole-v9", run_dir=tmp_path / "run", quiet=True)
    lines = str(failed.value).splitlines()
    assert lines[0].startswith("unknown environment 'CartPole-v9'")
    assert len(lines) == len(set(lines))
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_that_fails_keeps_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> NoReturn:
        raise RunFailedError("no GPU")

    monkeypatch.setattr(train_function, "run_locally", fail)
    spec = RunSpec.model_validate({"environment": {"id": "CartPole-v1"}})
    for resumed in (True, False):
        directory = tmp_path / str(resumed)
        create(directory, spec)
        with pytest.raises(daedalus.TrainingError, match="no GPU"):
            train_function._run(LocalRun(directory=directory, spec=spec, started=0.0, resume=resumed), True)
        assert directory.exists() == resumed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"preset": "cartpol"}, "unknown preset 'cartpol': did you mean cartpole"),
        ({}, "name a preset"),
        ({"preset": "cartpole", "settings": {"seed": 1}}, "settings 'seed': 'seed' has no section"),
        (
            {"preset": "cartpole", "settings": {"training.sed": 1}},
            "unknown setting training.sed: did you mean training.seed",
        ),
        ({"preset": "cartpole", "run_dir": "."}, "run directory . is not empty"),
        ({"preset": Path("absent.toml")}, "absent.toml does not exist"),
        ({"preset": "cartpole", "init_from": "nowhere"}, "--init-from: nowhere does not exist"),
        ({"preset": "cartpole", "allow_other_spaces": True}, "--allow-other-spaces is for the weights of another run"),
        (
            {"preset": "cartpole", "settings": {"environment.no_reward_limit": 9}},
            "training.target_return is 475, but training plays another task",
        ),
        (
            {"env": lambda: None, "settings": {"environment.backend": "pettingzoo"}},
            "setting environment environment.backend=pettingzoo needs a game of a module, and no module has ",
        ),
        ({"preset": "cartpole", "log": "tensorboard"}, "log: unknown tracker 'tensorboard': choose from wandb, mlflow"),
        ({"preset": "cartpole", "log": ["wandb", "x"]}, "log: unknown tracker 'x'"),
        (
            {"preset": "cartpole", "settings": {"environment.kwargs.x": np.zeros(2)}},
            "setting environment.kwargs.x is array([0., 0.]), which config.toml and messages to actors cannot",
        ),
    ],
)
def test_invalid_settings_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(daedalus.SettingsError) as refused:
        daedalus.train(**arguments)
    assert str(refused.value).startswith(message)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": 3}, 'env must be the id of a registered environment, such as "CartPole-v1", or a gymnasium.Env: its'),
        ({"env": dict}, "env must be the id of a registered environment"),
        ({"env": gymnasium.make_vec("CartPole-v1", 2)}, "env is CartPoleVectorEnv(CartPole-v1, num_envs=2), several"),
        ({"preset": gymnasium.make("CartPole-v1")}, "preset must be a name or a path, not <TimeLimit<OrderEnforcing"),
        ({"preset": "cartpole", "callback": print}, "callback must be an instance of a subclass of daedalus.Callback"),
        (
            {"preset": "cartpole", "callback": daedalus.Callback},
            "callback must be an instance of a subclass of daedalus.Callback",
        ),
        ({"preset": "cartpole", "settings": "training.seed=1"}, "settings must be a map such as {"),
        ({"preset": "cartpole", "settings": {1: 2}}, "settings must be a map such as {"),
    ],
)
def test_objects_of_other_types_are_refused(arguments: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(TypeError) as refused:
        daedalus.train(**arguments, run_dir=tmp_path / "run")
    assert str(refused.value).startswith(message)
    assert not (tmp_path / "run").exists()


def test_a_script_without_a_guard_is_reported(tmp_path: Path) -> None:
    """The process that checks the environment would import the script, train, start another one, and so on."""
    (tmp_path / "mine_unguarded.py").write_text(
        "import daedalus, gymnasium\n"
        "from gymnasium.envs.classic_control import CartPoleEnv\n"
        "gymnasium.register('Mine-v0', CartPoleEnv)\n"
        "daedalus.train(env='mine_unguarded:Mine-v0', env_steps=1000)\n"
    )
    command = [sys.executable, "mine_unguarded.py"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert ended.returncode == 1
    assert (
        "daedalus.train is called while mine_unguarded is imported, which the processes of the run do" in ended.stderr
    )
    assert 'put the call under `if __name__ == "__main__":`' in ended.stderr


def test_train_prints_what_its_processes_print_and_ctrl_c_ends_them_with_a_checkpoint(tmp_path: Path) -> None:
    # a shell starts background jobs with SIGINT ignored, and Python leaves it so
    program = """
import logging, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
import daedalus
settings = {"training.stop_when_solved": False, "environment.id": "slow_environment:Slow-v0"}
try:
    daedalus.train("cartpole", run_dir="interrupted-run", env_steps=10**9, actors=1, settings=settings)
finally:
    print(logging.getLogger("daedalus").handlers, flush=True)
"""
    shutil.copy(Path(__file__).parent / "slow_environment.py", tmp_path)
    running = Running([sys.executable, "-c", program], tmp_path)
    try:
        running.expect(r"slow_environment:Slow-v0: impala, seed 1, \d+ actors")  # of the log
        running.expect(r"  env_steps  .* updates .*/s")  # printed by the learner
        running.process.send_signal(signal.SIGINT)
        assert running.wait() != 0
        assert "[]" in running.lines
        assert running.lines[-1] == "KeyboardInterrupt", running.output
        until(lambda: not processes_mentioning("interrupted-run"))
        assert any((tmp_path / "interrupted-run" / "checkpoints").iterdir())
    finally:
        running.end()


# ---------------------------------------------------------------------------------- evaluate and read_metrics


def test_evaluate_returns_what_the_command_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(tmp_path, CARTPOLE, 3)
    result = daedalus.evaluate(tmp_path, episodes=4, seed=9, actions="sampled", backend="envpool")
    assert capsys.readouterr() == ("", "")
    words = ["--episodes", "4", "--seed", "9", "--actions", "sampled", "--backend", "envpool", "--json"]
    assert evaluate_command([str(tmp_path), *words]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (result.returns.tolist(), result.lengths.tolist()) == (printed["returns"], printed["lengths"])
    assert result.return_mean == printed["return_mean"] == result.returns.mean()
    assert (result.policy_version, result.seed, result.actions, result.backend) == (3, 9, "sampled", "envpool")
    assert (result.environment, result.video) == ("CartPole-v1", None)


def test_evaluate_records_a_video(tmp_path: Path) -> None:
    pytest.importorskip("PIL")
    save(tmp_path, CARTPOLE, 3)
    result = daedalus.evaluate(tmp_path, video=tmp_path / "play.gif", max_seconds=0.2, width=32)
    assert result.video == tmp_path / "play.gif"
    assert (tmp_path / "play.gif").read_bytes().startswith(b"GIF89a")
    assert len(result.returns) == 1


ELSEWHERE = """
import os
import sys
import gymnasium
import numpy as np

def leave():
    os.makedirs(ELSEWHERE, exist_ok=True)
    os.chdir(ELSEWHERE)
    os.umask(0)
    sys.path[:] = [entry for entry in sys.path if entry != HELPERS]

class Leaving(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, render_mode=None):
        self.render_mode, self.steps = render_mode, 0
        leave()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(2, np.float32), 1.0, self.steps == 5, False, {}

    def render(self):
        return np.zeros((8, 8, 3), np.uint8)

gymnasium.register("Leaving-v0", Leaving)
"""
LEAVING_NET = """
from leaving import leave
from torch import nn

class Net(nn.Module):
    def __init__(self, space):
        super().__init__()
        self.layer = nn.Linear(2, 8)
        leave()

    def forward(self, observation):
        leave()
        return self.layer(observation)
"""


def test_the_code_of_the_user_may_change_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of its process: relative paths mean what they meant before, and the program stays where it was."""
    here, elsewhere, helpers = tmp_path / "here", tmp_path / "elsewhere", str(tmp_path / "helpers")
    here.mkdir()
    (here / "leaving.py").write_text(f"ELSEWHERE = {str(elsewhere)!r}\nHELPERS = {helpers!r}\n{ELSEWHERE}")
    (here / "leaving_net.py").write_text(LEAVING_NET)  # with torch, which the processes of environments do not import
    monkeypatch.chdir(here)
    monkeypatch.syspath_prepend(helpers)

    class Restless(daedalus.Callback):
        rows = 0

        def on_start(self, run: daedalus.TrainingRun) -> None:
            os.chdir("/")

        def on_metrics(self, run: daedalus.TrainingRun, row: Mapping[str, float]) -> None:
            assert Path.cwd() == here
            self.rows += 1
            os.chdir("/")

        on_end = on_start

    callback = Restless()
    settings = {**BUDGET["settings"], "policy.encoder": "leaving_net:Net", "service.log_seconds": 0.05}
    settings["evaluation.final_episodes"] = 1
    result = daedalus.train(
        env="leaving:Leaving-v0", run_dir="run", callback=callback, settings=settings, env_steps=600, actors=1
    )
    assert callback.rows
    assert result.directory == Path("run")
    expected = {"config.toml", "versions.json", "metrics.csv", "summary.json", "evaluation.json", "events.jsonl"}
    assert expected < {file.name for file in (here / "run").iterdir()}
    assert list((here / "run" / "checkpoints").iterdir())
    played = daedalus.evaluate("run", video="run/play.gif", allow_modules=["leaving"])
    assert (here / "run" / "play.gif").is_file()
    assert evaluate_command(["run", "--allow-module", "leaving", "--record", "--episodes", "2"]) == 0
    assert len(json.loads((here / "run" / "evaluation.json").read_text())["returns"]) == 2
    assert stat.S_IMODE((here / "run" / "evaluation.json").stat().st_mode) & 0o022 == 0
    assert Path.cwd() == here
    assert helpers in sys.path
    assert played.lengths.tolist() == [5]
    assert not list(elsewhere.iterdir())


def test_invalid_arguments_of_evaluate_are_refused(tmp_path: Path) -> None:
    save(tmp_path / "run", COUNTING, 1)
    with pytest.raises(ValueError, match="name either a run directory"):
        daedalus.evaluate()
    with pytest.raises(ValueError, match="choose a number from 1 to"):
        daedalus.evaluate(tmp_path / "run", episodes=0)
    with pytest.raises(EnvironmentSetupError, match=r"pass allow_modules=\['counting_environment'\]"):
        daedalus.evaluate(tmp_path / "run", episodes=1)
    assert len(daedalus.evaluate(tmp_path / "run", episodes=1, allow_modules=["counting_environment"]).returns) == 1


def test_read_metrics_returns_the_columns_without_rows_that_a_resumed_run_repeated(tmp_path: Path) -> None:
    run = record(tmp_path / "run", returns=(1.0, None, 3.0, 4.0), env_steps=(1000, 3000, 2000, 4000))
    metrics = daedalus.read_metrics(str(run))
    assert metrics["env_steps"].tolist() == [1000.0, 2000.0, 4000.0]
    assert metrics["episode_return_mean"].tolist() == [1.0, 3.0, 4.0]
    with pytest.raises(daedalus.RunDataError, match="does not exist: name a run directory"):
        daedalus.read_metrics(tmp_path / "nowhere")
    with pytest.raises(daedalus.RunDataError, match="is a folder of run directories: name one of them"):
        daedalus.read_metrics(tmp_path)


# ------------------------------------------------------------------------------------------ load_policy


def play(policy: daedalus.Policy, environment: gymnasium.Env, seed: int, steps: int = 10_000) -> float:
    """Play one episode in a plain gymnasium loop and return its return."""
    observation, _ = environment.reset(seed=seed)
    policy.reset()
    total = 0.0
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = environment.step(policy.act(observation))
        total += float(reward)
        if terminated or truncated:
            break
    environment.close()
    return total


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"actions": "best"}, "actions is 'best': choose from greedy, sampled"),
        ({"backend": "gym"}, "backend is 'gym': choose from gymnasium, envpool, ale, fast"),
        ({"episodes": 2.5}, "episodes is 2.5: it must be a whole number"),
        ({"seed": "1"}, "seed is '1': it must be a whole number"),
        ({"width": 64.0, "video": "play.gif"}, "width is 64.0: it must be a whole number"),
    ],
)
def test_evaluate_refuses_values_that_the_command_cannot_have(arguments: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        daedalus.evaluate(pretrained="car_racing", **arguments)


def evaluated(directory: Path, seed: int) -> tuple[float, int]:
    """Evaluate one episode; return its return and the seed of its environment."""
    saved = find_policy(directory)
    runtime = OnnxRuntime(saved.program)
    runtime.load(saved.weights)
    with closing(
        make_environments(saved.spec.environment.as_evaluated("gymnasium"), 1, one_episode=True)
    ) as environments:
        evaluation = play_episodes(runtime, environments, 1, seed, sampled=False)
    return float(evaluation.returns[0]), int(np.random.SeedSequence(seed).generate_state(1)[0]) % 2**30


@pytest.mark.parametrize("memory", ["none", "gru"])
def test_a_loaded_policy_gets_the_returns_of_the_evaluation(tmp_path: Path, memory: str) -> None:
    save(tmp_path, CARTPOLE, 7, policy={"hidden": (16,), "memory": memory, "memory_units": 8})
    policy = daedalus.load_policy(tmp_path)
    assert (policy.policy_version, policy.spec.environment.id) == (7, "CartPole-v1")
    returns = []
    for seed in range(4):
        expected, environment_seed = evaluated(tmp_path, seed)
        returns.append(expected)
        assert play(policy, gymnasium.make("CartPole-v1"), environment_seed) == expected
    assert len(set(returns)) > 1


def test_the_pretrained_policy_plays_gymnasiums_car_racing() -> None:
    policy = daedalus.load_policy(pretrained="car_racing")
    environment = policy.spec.environment
    assert environment.action_repeat > 1
    assert environment.frame_stack != 1  # state that the policy keeps itself
    limit = 60
    own = environment.as_evaluated("gymnasium").model_copy(update={"max_episode_steps": limit, "processes": False})
    saved = find_policy(pretrained("car_racing"))
    runtime = OnnxRuntime(saved.program)
    runtime.load(saved.weights)
    with closing(make_environments(own, 1)) as environments:
        expected = play_episodes(runtime, environments, 1, 5, sampled=False).returns[0]
    seed = int(np.random.SeedSequence(5).generate_state(1)[0])
    kwargs: dict[str, Any] = dict(environment.kwargs)
    car = gymnasium.make(environment.id, max_episode_steps=limit, **kwargs)
    assert play(policy, car, seed) == pytest.approx(expected, abs=1e-3)


def test_stacked_frames_are_cleared_by_reset(tmp_path: Path) -> None:
    save(tmp_path, COUNTING, 1)
    with pytest.raises(EnvironmentSetupError, match=r"pass allow_modules=\['counting_environment'\]"):
        daedalus.load_policy(tmp_path)
    policy = daedalus.load_policy(tmp_path, allow_modules=["counting_environment"])
    space = policy.observation_space
    observations = [space.sample() for _ in range(5)]
    actions = [policy.act(observation) for observation in observations]
    policy.reset()
    assert [policy.act(observation) for observation in observations] == actions


def test_observations_that_are_no_codes_are_refused(tmp_path: Path) -> None:
    """A policy does not act on them, neither here nor in an evaluation."""
    spec = EnvironmentSpec(id="faulty_environments:Faulty-v0", kwargs={"fault": "map", "value": 8})
    save(tmp_path, spec, 1, policy={"codes": {"observation": (9,)}, "encoder": "mlp"})
    policy = daedalus.load_policy(tmp_path, allow_modules=["faulty_environments"])
    policy.act(np.full((20, 20), 8, np.uint8))
    with pytest.raises(ValueError, match="component 'observation' of the observation has the value 9 in place 0"):
        policy.act(np.full((20, 20), 9, np.uint8))
    saved = find_policy(tmp_path)
    runtime = OnnxRuntime(saved.program)
    runtime.load(saved.weights)
    other = spec.model_copy(update={"kwargs": {"fault": "map", "value": 9}})
    with (
        closing(make_environments(other, 2, modules=TEST_MODULES, one_episode=True)) as environments,
        pytest.raises(PolicyError, match=r"has a value that is not among policy\.codes"),
    ):
        play_episodes(runtime, environments, 1, 1, sampled=False)


@pytest.mark.parametrize("sampled", [False, True])
def test_a_batch_has_the_actions_of_single_calls_with_values_and_probabilities(tmp_path: Path, sampled: bool) -> None:
    save(tmp_path, CARTPOLE, 1)
    policy = daedalus.load_policy(tmp_path)
    observations = np.random.default_rng(2).uniform(-0.5, 0.5, (64, 4)).astype(np.float32)
    policy.reset(seed=3)
    decisions = policy.act_batch(observations, sampled=sampled)
    assert decisions.actions.shape == decisions.values.shape == decisions.log_probs.shape == (64,)
    probabilities = decisions.probabilities["action"]
    assert probabilities.shape == (64, 1, 2)
    np.testing.assert_allclose(probabilities.sum(-1), 1.0, rtol=1e-5)
    chosen = probabilities[np.arange(64), 0, decisions.actions]
    np.testing.assert_allclose(np.exp(decisions.log_probs), chosen, rtol=1e-4)
    np.testing.assert_allclose(
        decisions.entropies, -(probabilities * np.log(probabilities)).sum((1, 2)), rtol=1e-3, atol=1e-5
    )
    assert len(set(decisions.values.tolist())) == 64
    if not sampled:
        assert decisions.actions.tolist() == [int(policy.act(observation)) for observation in observations]
        assert decisions.actions.tolist() == probabilities[:, 0].argmax(-1).tolist()
    alone = policy.act_batch(observations[5:6])
    np.testing.assert_allclose(alone.values, decisions.values[5:6], rtol=1e-4)


def test_a_batch_is_refused_for_a_policy_that_remembers(tmp_path: Path) -> None:
    save(tmp_path, COUNTING, 1)
    policy = daedalus.load_policy(tmp_path, allow_modules=["counting_environment"])
    with pytest.raises(ValueError, match="remembers earlier observations"):
        policy.act_batch([policy.observation_space.sample()])


def test_sampled_actions_depend_on_the_seed(tmp_path: Path) -> None:
    save(tmp_path, CARTPOLE, 1)
    policy = daedalus.load_policy(tmp_path)
    observation = np.zeros(4, np.float32)

    def sampled(seed: int) -> list[int]:
        policy.reset(seed=seed)
        return [int(policy.act(observation, sampled=True)) for _ in range(64)]

    assert sampled(1) == sampled(1) != sampled(2)
    assert len(set(sampled(1))) == 2


def test_load_policy_accepts_spaces_instead_of_the_environment(tmp_path: Path) -> None:
    save(tmp_path, CARTPOLE, 1)
    space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float64)
    policy = daedalus.load_policy(tmp_path, observation_space=space, action_space=gymnasium.spaces.Discrete(2, start=5))
    assert policy.act(space.sample()) in (5, 6)
    with pytest.raises(EnvironmentSetupError, match="the policy was trained on"):
        daedalus.load_policy(tmp_path, observation_space=space, action_space=gymnasium.spaces.Discrete(3))


def test_invalid_arguments_of_load_policy_and_act_are_refused(tmp_path: Path) -> None:
    save(tmp_path, CARTPOLE, 1)
    with pytest.raises(ValueError, match="either a run directory or a pretrained policy"):
        daedalus.load_policy()
    with pytest.raises(ValueError, match="both observation_space and action_space"):
        daedalus.load_policy(tmp_path, action_space=gymnasium.spaces.Discrete(2))
    with pytest.raises(daedalus.NoPolicyError, match="no pretrained policy 'car_race'"):
        daedalus.load_policy(pretrained="car_race")
    for read in (daedalus.load_policy, daedalus.evaluate):
        with pytest.raises(daedalus.NoPolicyError, match="nowhere does not exist"):
            read(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="has shape"):
        daedalus.load_policy(tmp_path).act(np.zeros(5))


def test_a_policy_with_masks_names_the_mask_that_the_caller_left_out(tmp_path: Path) -> None:
    save(tmp_path, EnvironmentSpec(id="nested_environment:NestedMasked-v0"), 1)
    policy = daedalus.load_policy(tmp_path, allow_modules=["nested_environment"])
    observation, info = gymnasium.make("NestedMasked-v0").reset(seed=1)
    with pytest.raises(ValueError, match=r"trained with masks.*: call act\(observation, action_mask=MASK\), with info"):
        policy.act(observation)
    action = policy.act(observation, action_mask=info["action_mask"])
    assert info["action_mask"]["0"][action[0]] == 1


def test_a_policy_without_masks_does_not_ignore_a_mask(tmp_path: Path) -> None:
    save(tmp_path, CARTPOLE, 1)
    policy = daedalus.load_policy(tmp_path)
    with pytest.raises(ValueError, match=r"trained without masks .*: call act\(observation\) without action_mask"):
        policy.act(np.zeros(4), action_mask=np.ones(2))


def test_a_policy_takes_the_mask_of_the_observation(tmp_path: Path) -> None:
    observation_space = gymnasium.spaces.Dict(
        {"seen": gymnasium.spaces.Box(0, 9, (1,)), "action_mask": gymnasium.spaces.Box(0, 1, (3,), np.int8)}
    )
    spaces = Spaces(
        observations={"seen": ArraySpace(shape=(1,), dtype="float32")},
        actions={"action": DiscreteSpace(counts=(3,), masked=True)},
    )
    save(tmp_path, CARTPOLE, 1, spaces=spaces)
    policy = daedalus.load_policy(
        tmp_path, observation_space=observation_space, action_space=gymnasium.spaces.Discrete(3)
    )
    assert policy.act({"seen": np.zeros(1), "action_mask": np.array([0, 1, 0], np.int8)}) == 1
