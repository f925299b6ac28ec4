"""Test of `daedalus evaluate`: policies, backends, results, videos, and the evaluation after training."""

import importlib
import json
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import safetensors.numpy
from counting_environment import Counting
from PIL import Image
from processes import LIMIT, Running, processes_mentioning
from saved_runs import CARTPOLE, COUNTING, RACING, save, score

from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.analysis.recorded_run import read_record
from daedalus.cli.commands.evaluate import main
from daedalus.cli.commands.train import report as report_of
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.final_evaluation import FinalEpisodes
from daedalus.launch.local_run import LocalRun, RunStoppedError
from daedalus.launch.local_training import evaluate_run
from daedalus.learner.run.run_directory import create, read_json, write_config, write_json
from daedalus.learner.target_confirmation import confirmation
from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_score
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.protocol.spaces import DiscreteSpace
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.protocol.texts import short_number
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

Start = Callable[..., Running]


@pytest.fixture
def evaluate(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """Function that runs the command in this process and returns its result."""

    def run(*words: object) -> dict[str, Any]:
        capsys.readouterr()
        status = main([*map(str, words), "--json", "--allow-module", "counting_environment"])
        captured = capsys.readouterr()
        assert status == 0, captured.err
        return json.loads(captured.out)

    return run


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Function that runs the command in this process and returns its one-line error message."""

    def run(status: int, *words: object) -> str:
        capsys.readouterr()
        assert main([*map(str, words)]) == status
        captured = capsys.readouterr()
        assert captured.out == ""
        (line,) = captured.err.splitlines()
        return line

    return run


# ------------------------------------------------------------------------------------------------ policy and seed


def test_episodes_are_not_cut_by_the_no_reward_limit(tmp_path: Path, evaluate: Callable[..., dict]) -> None:
    """The first reward of the first episode is 0, at which training would cut it."""
    run = save(tmp_path / "run", COUNTING.model_copy(update={"no_reward_limit": 1}), 3)
    assert evaluate(run, "--episodes", 2, "--envs", 2)["lengths"] == [3, 3]


@pytest.mark.parametrize("reward", [1_000_001.0, 2e-5 / 3, 16_777_217.0, -1e9 - 1, 0.1])
def test_returns_are_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, evaluate: Callable[..., dict], reward: float
) -> None:
    """In single precision, or with four decimals, each of them would be another number."""
    step = Counting.step
    monkeypatch.setattr(Counting, "step", lambda *given: (*(made := step(*given))[:1], reward / 4, *made[2:]))
    run = save(tmp_path / "run", COUNTING, 3)
    result = evaluate(run, "--episodes", 1)
    assert result["returns"] == [reward / 4 * result["lengths"][0]] == [result["return_mean"]]


@pytest.mark.parametrize("memory", ["none", "gru"])
def test_whole_episodes_are_played_in_rounds_by_the_policy(
    tmp_path: Path, evaluate: Callable[..., dict], memory: str
) -> None:
    run = save(tmp_path / "run", COUNTING, 3, policy={"hidden": (16,), "memory": memory, "memory_units": 8})
    result = evaluate(run, "--episodes", 11, "--envs", 3)
    assert sorted(result["lengths"]) == [1] * 3 + [2] * 3 + [3] * 5
    assert result["return_mean"] == pytest.approx(np.mean(result["returns"]), rel=1e-6)
    assert (result["environment"], result["backend"]) == (COUNTING.id, "gymnasium")
    assert (result["episodes"], result["policy_version"], result["actions"]) == (11, 3, "greedy")


def test_evaluate_uses_the_best_checkpoint_or_the_newest_on_request(
    tmp_path: Path, evaluate: Callable[..., dict]
) -> None:
    run = save(tmp_path / "run", COUNTING, 5, 6, 7, 8, 9)
    assert evaluate(run, "--episodes", 1)["policy_version"] == 9
    for version, found in ((5, 9.5), (6, 12.25), (7, -20.5)):
        score(run, found, version)
    best = evaluate(run, "--episodes", 1)
    assert (best["policy_version"], best["best_checkpoint"]) == (6, True)
    assert best["checkpoint"].endswith("best_12.25_0000000006")
    newest = evaluate(run, "--episodes", 1, "--newest")
    assert (newest["policy_version"], newest["best_checkpoint"]) == (9, False)
    assert evaluate(run / "checkpoints" / "0000000008", "--episodes", 1)["policy_version"] == 8
    assert [entry.name for entry in checkpoints(run)] == ["0000000009", "0000000008"]


def test_a_damaged_best_checkpoint_is_reported_and_the_newest_is_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = save(tmp_path / "run", COUNTING, 1, 2)
    (score(run, 3.0, 1) / "parameters.safetensors").write_bytes(b"")
    assert main([str(run), "--episodes", "1", "--allow-module", "counting_environment"]) == 0
    captured = capsys.readouterr()
    assert "skipped a damaged checkpoint" in captured.err
    assert "best_3.0_0000000001" in captured.err
    assert "counting_environment:Counting-v0 (backend gymnasium), policy version 2: return 3." in captured.out


def test_sampled_actions_depend_on_the_seed_and_greedy_is_the_default(
    tmp_path: Path, evaluate: Callable[..., dict]
) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1)
    one, same, other = (evaluate(run, "--episodes", 5, "--seed", seed, "--actions", "sampled") for seed in (3, 3, 4))
    assert one == same
    assert one["actions"] == "sampled"
    assert one["returns"] != other["returns"]
    assert one["returns"] != evaluate(run, "--episodes", 5, "--seed", 3)["returns"]
    run = save(tmp_path / "sampling", CARTPOLE, 1, evaluation={"actions": "sampled"})
    assert evaluate(run, "--episodes", 5)["actions"] == "sampled"
    assert evaluate(run, "--episodes", 5, "--actions", "greedy")["actions"] == "greedy"


# ------------------------------------------------------------------------------------------------ environment


def test_the_backend_is_that_of_the_run_or_of_the_option(tmp_path: Path, evaluate: Callable[..., dict]) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1, evaluation={"final_backend": "envpool"})
    assert evaluate(run, "--episodes", 2)["backend"] == "envpool"
    assert evaluate(run, "--episodes", 2, "--backend", "gymnasium")["backend"] == "gymnasium"


def test_spaces_that_differ_from_those_of_the_policy_are_reported(tmp_path: Path, refused: Callable[..., str]) -> None:
    spaces = make_environments(CARTPOLE, 1).spaces.model_copy(
        update={"actions": {"action": DiscreteSpace(counts=(3,))}}
    )
    run = save(tmp_path / "run", CARTPOLE, 1, spaces=spaces)
    line = refused(1, run, "--episodes", 1)
    assert "CartPole-v1 (backend gymnasium) has observation: float32 array of shape (4,); action: 2 choices" in line
    assert "trained on observation: float32 array of shape (4,); action: 3 choices" in line


def test_the_option_wrap_imports_the_users_function(tmp_path: Path, refused: Callable[..., str]) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1)
    assert "no_such_module" in refused(1, run, "--episodes", 1, "--wrap", "no_such_module:function")
    assert "--wrap is f: write MODULE:FUNCTION, or none" in refused(2, run, "--wrap", "f")


def test_a_module_that_only_the_run_names_is_refused_with_the_command_that_allows_it(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    run = save(tmp_path / "run", COUNTING, 1)
    assert refused(2, run, "--episodes", 3) == (
        f"daedalus evaluate: the run of {run}/checkpoints/0000000001 asks for "
        "environment.id=counting_environment:Counting-v0, but the module counting_environment may not be imported "
        f"here; if you trust that code, type: daedalus evaluate {run} --episodes 3 --allow-module counting_environment"
    )


def test_the_wrapper_of_the_run_is_used_unless_the_option_names_another(
    tmp_path: Path, evaluate: Callable[..., dict], refused: Callable[..., str]
) -> None:
    wrap = "picture_environment:with_doubled_rewards"
    run = save(tmp_path / "run", CARTPOLE.model_copy(update={"wrap": wrap}), 1)
    options = ("--episodes", 1, "--seed", 3)
    assert "but the module picture_environment may not be imported here" in refused(2, run, *options)
    doubled = evaluate(run, *options, "--allow-module", "picture_environment")
    plain = evaluate(run, *options, "--wrap", "none")
    assert doubled["return_mean"] == 2 * plain["return_mean"] > 0
    own = evaluate(save(tmp_path / "plain", CARTPOLE, 1), *options, "--wrap", wrap)
    assert own["return_mean"] == doubled["return_mean"]


# ------------------------------------------------------------------------------------------------ video and window


def test_a_video_has_every_frame_before_action_repeat(tmp_path: Path, evaluate: Callable[..., dict]) -> None:
    run = save(tmp_path / "run", RACING, 1)
    result = evaluate(run, "--video", tmp_path / "drive.mp4", "--seed", 2)
    assert result["episodes"] == 1
    assert result["lengths"] == [3]  # ten frames, four per env_step
    assert result["video_seconds"] == 11 / 50
    with av.open(str(tmp_path / "drive.mp4")) as container:
        assert container.streams.video[0].average_rate == 50
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 11  # the first frame is before the first action
    assert frames[0].shape == (400, 600, 3)
    assert any((frames[0] != frame).any() for frame in frames[1:])
    assert evaluate(run, "--episodes", 1, "--seed", 2)["returns"] == result["returns"]


@pytest.mark.parametrize("name", ["film.mp4", "film.gif"])
def test_a_video_plays_at_the_speed_of_the_environment_or_a_note_says_that_it_is_guessed(
    tmp_path: Path, evaluate: Callable[..., dict], name: str
) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1)
    options = ("--video", tmp_path / name, "--seed", 1, "--wrap")
    slow = evaluate(run, *options, "picture_environment:with_a_rate_of_its_own", "--max-seconds", 0.5)
    assert slow["video_seconds"] == pytest.approx(4 / 7, abs=0.005)
    assert slow["notes"] == ["the last episode was cut at the end of the video"]
    guessed = evaluate(run, *options, "picture_environment:without_rate")
    assert guessed["video_seconds"] == pytest.approx((guessed["lengths"][0] + 1) / 30, abs=0.005)
    assert guessed["notes"] == [
        "the speed of the video: the environment states no render_fps: 30 frames a second are a guess"
    ]


def test_a_recorded_evaluation_replaces_that_of_the_run(tmp_path: Path, evaluate: Callable[..., dict]) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1)
    write_config(run, RunSpec(environment=CARTPOLE))
    (run / "evaluation.json").write_text("of another time")
    (run / "summary.json").write_text('{"env_steps": 7, "evaluation_return_mean": 1.0}')
    result = evaluate(run, "--episodes", 2, "--record")
    summary = json.loads((run / "summary.json").read_text())  # what compare reads
    assert (summary["env_steps"], summary["evaluation_return_mean"]) == (7, result["return_mean"])
    assert summary["evaluation"]["policy_version"] == result["policy_version"]
    assert read_json(run / "evaluation.json") == result


def test_a_video_of_an_atari_game_uses_gymnasiums_implementation(tmp_path: Path, evaluate: Callable[..., dict]) -> None:
    pong = EnvironmentSpec(id="Pong-v5", backend="envpool", action_repeat=4, grey=True, resize=(21, 21))
    run = save(tmp_path / "run", pong.model_copy(update={"frame_stack": 4, "max_episode_steps": 40}), 1)
    options = ("--episodes", 2, "--seed", 1)
    on_envpool, on_gymnasium = evaluate(run, *options), evaluate(run, *options, "--video", tmp_path / "pong.mp4")
    assert (on_envpool["environment"], on_gymnasium["environment"]) == ("Pong-v5", "ALE/Pong-v5")
    assert on_gymnasium["lengths"] == on_envpool["lengths"] == [10, 10]
    assert on_gymnasium["video_seconds"] == 2 * 41 / 60


def test_a_video_of_a_game_has_a_frame_for_each_step(tmp_path: Path, evaluate: Callable[..., dict]) -> None:
    run = save(tmp_path / "run", EnvironmentSpec(id="pettingzoo.classic.tictactoe_v3"), 1)
    filmed = evaluate(run, "--video", tmp_path / "game.gif", "--episodes", 2, "--seed", 1)
    assert filmed["video_seconds"] == sum(filmed["lengths"]) + 2  # a frame a second, and one before each match
    assert filmed["lengths"] == evaluate(run, "--episodes", 2, "--seed", 1)["lengths"]


def test_max_seconds_ends_the_gif_and_the_evaluation(tmp_path: Path, evaluate: Callable[..., dict]) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1)
    options = ("--video", tmp_path / "short.gif", "--episodes", 3, "--seed", 1)
    result = evaluate(run, *options, "--max-seconds", 0.1, "--width", 150)
    assert result["video_seconds"] == 0.1
    with Image.open(tmp_path / "short.gif") as image:
        assert image.size == (150, 100)
        assert getattr(image, "n_frames", 1) == 2  # every fourth of five
    assert result["lengths"] == [4]
    assert result["notes"] == ["the last episode was cut at the end of the video"]


def test_episodes_that_never_end_are_cut_and_the_result_says_so(
    tmp_path: Path, evaluate: Callable[..., dict], capsys: pytest.CaptureFixture[str]
) -> None:
    endless = COUNTING.model_copy(update={"kwargs": {"ends": [10**9]}})
    run = save(tmp_path / "run", endless, 1, evaluation={"max_episode_env_steps": 30})
    cut = "2 of 2 episodes were cut after 30 env_steps (evaluation.max_episode_env_steps): "
    remedy = "if the environment never ends them, set environment.max_episode_steps"
    note = f"{cut}greedy actions may go in circles where sampled ones do not (--actions sampled); {remedy}"
    result = evaluate(run, "--episodes", 2)
    assert (result["lengths"], result["notes"]) == ([30, 30], [note])
    assert main([str(run), "--episodes", "2", "--allow-module", "counting_environment"]) == 0
    assert capsys.readouterr().out.endswith(f" greedy episodes\n{note}\n")
    assert evaluate(run, "--episodes", 2, "--actions", "sampled")["notes"] == [cut + remedy]


def test_render_needs_a_screen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, evaluate: Callable[..., dict], refused: Callable[..., str]
) -> None:
    run = save(tmp_path / "run", CARTPOLE.model_copy(update={"max_episode_steps": 5}), 1)
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "needs a screen, and this machine has none: record the episodes with --video" in refused(2, run, "--render")
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert evaluate(run, "--render", "--seed", 1)["lengths"] == [5]


# ------------------------------------------------------------------------------------------------ pretrained policies


def test_a_shipped_policy_gets_the_returns_of_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, evaluate: Callable[..., dict], refused: Callable[..., str]
) -> None:
    monkeypatch.setattr("daedalus.policy.saving.saved_policy.PRETRAINED", tmp_path / "pretrained")
    assert "'cartpole': none ships" in refused(1, "--pretrained", "cartpole")
    create(tmp_path / "run", RunSpec(environment=CARTPOLE))
    run = save(tmp_path / "run", CARTPOLE, 4, 5)
    score(run, 77.0, 4)
    (run / "metrics.csv").write_text("row\n" + "".join(f"{row}\n" for row in range(4000)))
    write_json(run / "summary.json", {"env_steps": 1234, "evaluation": None})
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent.parent))
    ship = importlib.import_module("benchmarks.ship_pretrained").ship
    shipped = ship(run, tmp_path / "pretrained" / "cartpole-1")
    assert {entry.name for entry in shipped.iterdir()} == {
        *("manifest.json", "seal", "program.onnx", "parameters.safetensors"),
        *("config.toml", "metrics.csv", "README.md"),
    }
    assert safetensors.numpy.load_file(shipped / "parameters.safetensors")
    assert (shipped / "metrics.csv").read_text().splitlines()[::999] == ["row", "3995"]
    assert "daedalus evaluate --pretrained cartpole-1\n" in (shipped / "README.md").read_text()
    of_the_run, of_the_shipped = evaluate(run, "--episodes", 3), evaluate("--pretrained", "cartpole-1", "--episodes", 3)
    for name in ("returns", "policy_version", "seed"):
        assert of_the_run[name] == of_the_shipped[name]
    line = refused(1, "--pretrained", "cartpole")
    assert "no pretrained policy 'cartpole': did you mean cartpole-1? choose from cartpole-1" in line
    assert "no pretrained policy '../run'" in refused(1, "--pretrained", "../run")


def test_the_pretrained_car_racing_policy_drives(evaluate: Callable[..., dict]) -> None:
    result = evaluate("--pretrained", "car_racing", "--backend", "fast", "--episodes", 2)
    assert result["return_mean"] > 600  # 905 over 100 episodes; a car that stands still has -100


# ------------------------------------------------------------------------------------------------ after training


@pytest.fixture
def output(tmp_path: Path) -> Iterator[ChildOutput]:
    with ChildOutput(tmp_path / "output.log", lambda _: None, lambda _: None) as output:
        yield output


def test_the_final_evaluation_uses_the_best_checkpoint_and_the_final_backend(
    tmp_path: Path, output: ChildOutput
) -> None:
    settings = {"final_episodes": 3, "final_backend": "envpool"}
    run = save(tmp_path / "run", CARTPOLE, 4, 5, evaluation=settings)
    score(run, 77.0, 4)
    (run / "checkpoints" / "0000000005").rename(tmp_path / "no newer one")
    spec = read_policy(run / "checkpoints" / "best_77.0_0000000004").spec
    write_config(run, spec)
    write_json(run / "summary.json", {"solved": False, "env_steps": 1234, "updates": 5})
    local_run = LocalRun(directory=run, spec=spec, started=0.0)
    summary = evaluate_run(local_run, threading.Event(), output)
    result = read_json(run / "summary.json")
    evaluation = result["evaluation"]
    assert (evaluation["policy_version"], evaluation["best_checkpoint"]) == (4, True)
    assert (evaluation["backend"], evaluation["episodes"], evaluation["actions"]) == ("envpool", 3, "greedy")
    assert evaluation["select_best"] == []
    episodes = read_json(run / "evaluation.json")
    assert len(episodes["returns"]) == len(episodes["lengths"]) == 3
    recorded = read_record(_with_metrics(run)).evaluation
    assert recorded is not None
    assert (recorded.returns, recorded.policy_version) == (tuple(episodes["returns"]), 4)
    assert result["evaluation_return_mean"] == evaluation["return_mean"]
    assert result == summary
    report = report_of(local_run, summary)
    assert " over 3 greedy episodes of the best checkpoint on CartPole-v1 (backend envpool)" in report


def _with_metrics(run: Path) -> Path:
    (run / "metrics.csv").write_text("env_steps,episode_return_mean\n1,1\n")
    return run


def test_the_best_checkpoint_is_selected_by_new_episodes_before_the_final_evaluation(
    tmp_path: Path, evaluate: Callable[..., dict], output: ChildOutput
) -> None:
    run = tmp_path / "run"
    for version in (1, 2, 3):
        save(run, CARTPOLE, version, weights_seed=version, evaluation={"final_episodes": 20})
    worst, *_, best = sorted((1, 2, 3), key=lambda version: _played(evaluate, run, version))
    score(run, 499.0, worst)
    write_json(run / "summary.json", {})
    spec = read_policy(run / "checkpoints" / f"{best:010d}").spec
    write_config(run, spec)
    newest = max(version for version in (1, 2, 3) if version != worst)
    evaluate_run(LocalRun(directory=run, spec=spec, started=0.0), threading.Event(), output)
    summary = read_json(run / "summary.json")
    evaluation = summary["evaluation"]
    assert (evaluation["policy_version"], evaluation["best_checkpoint"]) == (newest, True)
    assert "sampled_evaluation" not in summary  # no training episode has ended, which these could be worse than
    scores = [(each["policy_version"], each["return_mean"]) for each in evaluation["select_best"]]
    assert [version for version, _ in scores] == [newest, worst]
    assert evaluate(run, "--episodes", 1)["policy_version"] == newest
    assert not (run / "checkpoints" / f"best_499.0_{worst:010d}").exists()
    assert [best_score(each) for each in best_checkpoints(run)] == [each for _, each in scores]


def evaluated_here(run: LocalRun) -> dict[str, Any]:
    """Evaluate a run that has been trained, as `evaluate_run` does with processes, and return the summary."""
    network, stop = MemoryNetwork(), threading.Event()
    evaluator = Evaluator(ActorConfig(name="evaluation-0", incarnation=1), MemoryTransport(network), stop)
    thread = threading.Thread(target=evaluator.run, daemon=True)
    thread.start()
    with closing(MemoryTransport(network)) as transport:
        try:
            FinalEpisodes(run.directory, run.spec, transport, stop).evaluate()
        finally:
            stop.set()
            thread.join(LIMIT)
    return read_json(run.directory / "summary.json")


def test_new_sampled_episodes_that_confirmed_the_target_are_reported(tmp_path: Path) -> None:
    run = save(tmp_path / "run", CARTPOLE, 5, evaluation={"final_episodes": 10})
    played = {"return_mean": 21.5, "return_std": 4.0, "episodes": 40}
    solved = {"solved": True, "seconds_to_target": 1.0, "env_steps": 9, "updates": 5, "episode_return_mean": 1000.5}
    write_json(run / "summary.json", {**solved, "confirmation": confirmation(played, 20.0)})
    spec = read_policy(run / "checkpoints" / "0000000005").spec
    local_run = LocalRun(directory=run, spec=spec, started=0.0)
    summary = evaluated_here(local_run)
    report = report_of(local_run, summary)
    assert "confirmation: return 21.5 over 40 new sampled episodes" in report
    assert report.splitlines()[1].endswith("95 % interval 20.2 to 22.8; training mean 1000.5")
    assert "sampled_evaluation" not in summary  # the confirmation has sampled episodes already


@pytest.mark.parametrize(
    ("training_mean", "limit", "plays_again"), [(1000.0, None, True), (1.0, None, False), (1000.0, 400, False)]
)
def test_greedy_episodes_that_are_worse_than_training_are_played_again_with_sampled_actions(
    tmp_path: Path, training_mean: float, limit: int | None, plays_again: bool
) -> None:
    """Not where training played another task, as with no_reward_limit: its returns say nothing then."""
    environment = CARTPOLE.model_copy(update={"no_reward_limit": limit})
    run = save(tmp_path / "run", environment, 5, evaluation={"final_episodes": 10})
    spec = read_policy(run / "checkpoints" / "0000000005").spec
    trained = {"solved": False, "env_steps": 9, "updates": 5, "episode_return_mean": training_mean}
    write_json(run / "summary.json", trained)
    local_run = LocalRun(directory=run, spec=spec, started=0.0)
    summary = evaluated_here(local_run)
    assert summary["evaluation"]["actions"] == "greedy"
    assert summary["evaluation_return_mean"] == summary["evaluation"]["return_mean"]
    assert ("sampled_evaluation" in summary) == plays_again
    assert ("sampled actions: return" in report_of(local_run, summary)) == plays_again
    assert (
        f"the return {short_number(1000.0)} of training is that of another task" in report_of(local_run, summary)
    ) == bool(limit)
    if plays_again:
        sampled = read_json(run / "summary.json")["sampled_evaluation"]
        assert (sampled["actions"], sampled["episodes"], sampled["policy_version"]) == ("sampled", 10, 5)
        assert sampled["seed"] == summary["evaluation"]["seed"]
        (note,) = read_json(run / "evaluation.json")["notes"]
        assert note.startswith(f"sampled actions: return {short_number(sampled['return_mean'])} +- ")


def _played(evaluate: Callable[..., dict], run: Path, version: int) -> float:
    return evaluate(run / "checkpoints" / f"{version:010d}", "--episodes", 20)["return_mean"]


def test_the_final_evaluation_ends_when_training_is_stopped(tmp_path: Path, output: ChildOutput) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1, evaluation={"final_episodes": 10_000})
    write_json(run / "summary.json", {})
    spec = read_policy(run / "checkpoints" / "0000000001").spec
    write_config(run, spec)
    stopping = threading.Event()
    stopping.set()
    with pytest.raises(RunStoppedError):
        evaluate_run(LocalRun(directory=run, spec=spec, started=0.0), stopping, output)
    assert not processes_mentioning(str(run))


# ------------------------------------------------------------------------------------------------ command line


def test_progress_is_written_to_standard_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = save(tmp_path / "run", COUNTING, 1)
    monkeypatch.setattr("daedalus.actor.evaluation.episodes.PROGRESS_SECONDS", 0.0)
    options = ["--json", "--episodes", "2", "--envs", "1", "--allow-module", "counting_environment"]
    assert main([str(run), *options]) == 0
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert lines[0] == "evaluation: 0 of 2 episodes (each is cut after 27,000 env_steps)"
    assert lines[2].startswith("evaluation: 1 of 2 episodes, mean return 3.")
    assert len(json.loads(captured.out)["returns"]) == 2


def test_a_stopped_evaluation_leaves_no_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = save(tmp_path / "run", CARTPOLE, 1)
    stop = threading.Event()
    stop.set()
    assert main([str(run), "--video", str(tmp_path / "film.mp4")], stop) == 1
    assert capsys.readouterr().err == "daedalus evaluate: stopped\n"
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


def test_a_signal_ends_an_evaluation(start: Start, tmp_path: Path) -> None:
    save(tmp_path / "run", CARTPOLE, 1)
    running = start("evaluate", "run", "--episodes", 10**6)
    running.expect("evaluation: .* of 1000000 episodes, mean return")
    running.process.send_signal(signal.SIGTERM)
    assert running.wait() == 1
    assert running.lines[-1] == "daedalus evaluate: stopped"


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        ([], 2, "name either a run directory"),
        (["RUN", "--pretrained", "x"], 2, "name either a run directory"),
        (["RUN", "--episodes", 0], 2, "--episodes is 0: choose a number from 1 to 1,000,000"),
        (["RUN", "--episodes", 10**13], 2, "--episodes is 10000000000000: choose a number from 1 to 1,000,000"),
        (["RUN", "--envs", 0], 2, "--envs is 0: choose a number from 1 to 4096"),
        (["RUN", "--seed", -1], 2, "--seed is -1: choose 0 or more"),
        (["RUN", "--video", "x.avi"], 2, "--video is x.avi: the name must end with .mp4 or .gif"),
        (["RUN", "--video", "nowhere/x.mp4"], 1, "cannot write nowhere/x.mp4: No such file or directory"),
        (["RUN", "--video", "x.mp4", "--render"], 2, "--video and --render cannot be used together"),
        (["RUN", "--video", "x.mp4", "--envs", 2], 2, "leave out --envs 2"),
        (["RUN", "--video", "x.mp4", "--backend", "envpool"], 2, "leave out --backend envpool"),
        (["RUN", "--video", "x.mp4", "--width", 3], 2, "--width is 3: choose a number from 16 to 4096"),
        (["RUN", "--video", "x.mp4", "--max-seconds", 0], 2, "--max-seconds is 0: choose a number above 0"),
        (["RUN", "--video", "x.mp4", "--max-seconds", 5, "--record"], 2, "--max-seconds cuts them: use one of"),
        (["RUN", "--max-seconds", 5], 2, "need --video FILE"),
        (["RUN", "--backend", "ale"], 1, "unknown environment 'CartPole-v1'"),
        (["nowhere"], 1, "nowhere does not exist: name a run directory"),
        (["RUN", "--record"], 2, "is not a run directory: it has no config.toml"),
        (["--pretrained", "car_racing", "--record"], 2, "--record keeps the result in a run directory"),
    ],
)
def test_a_mistake_is_reported_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    refused: Callable[..., str],
    words: list[object],
    status: int,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    run = save(tmp_path / "run", CARTPOLE, 1)
    assert message in refused(status, *[run if word == "RUN" else word for word in words])
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]
