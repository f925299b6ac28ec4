"""`daedalus evaluate`: play episodes with a policy and print their returns."""

import argparse
import json
import os
import sys
import threading
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any, TextIO

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import as_on_gymnasium
from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.episodes import Evaluation, cut_note, environments_for, play_episodes
from daedalus.actor.evaluation.video import Video, VideoError
from daedalus.cli.arguments import allowing
from daedalus.cli.commands.evaluate_arguments import check, parser
from daedalus.cli.evaluation_progress import EvaluationProgress, EvaluationStoppedError
from daedalus.cli.logs import configure_logging, print_error, say
from daedalus.cli.processes import (
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    open_standard_streams,
    stop_on_signals,
)
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyError
from daedalus.policy.saving.best_checkpoints import is_best, is_best_in_training
from daedalus.policy.saving.hub import HubError, RepositoryNameError, pull
from daedalus.policy.saving.saved_policy import NoPolicyError, SavedPolicy, find_policy, pretrained
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import ModuleNotAllowedError, UserModules, module_of
from daedalus.protocol.spec import EnvironmentSpec
from daedalus.protocol.texts import short_number

_FAILURES = (
    EvaluationStoppedError,
    DamagedError,
    EnvironmentSetupError,
    HubError,
    NoPolicyError,
    PolicyError,
    VideoError,
)


def main(
    command_line: Sequence[str] | None = None, stop: threading.Event | None = None, output: TextIO | None = None
) -> int:
    """Run `daedalus evaluate` and return its exit status: 0 done, 1 failed or stopped, 2 bad usage.

    Args:
      command_line: the words after `daedalus evaluate`; default: those of this process.
      stop: ends the evaluation.
      output: receives the result, and nothing else (default: standard output).
    """
    output = output or sys.stdout
    words = sys.argv[1:] if command_line is None else command_line
    with redirect_stdout(output):  # for --help
        arguments = parser().parse_args(words)
    configure_logging(
        arguments.log_level,
        as_json=arguments.log_json,
        prefix="daedalus evaluate: ",
        write=lambda line: say(line, sys.stderr),
    )
    stop = stop or threading.Event()
    try:
        check(arguments)
    except ValueError as error:
        print_error("evaluate", error)
        return 2
    if arguments.record and not (arguments.directory / "config.toml").is_file():
        print_error("evaluate", f"--record: {arguments.directory} is not a run directory: it has no config.toml")
        return 2
    if arguments.exit_with_parent:
        exit_with_parent(stop)
    try:
        with redirect_stdout(sys.stderr):  # the environment may print
            result = run_evaluation(arguments, stop, sys.stderr)
    except ModuleNotAllowedError as error:
        print_error("evaluate", allowing(error, ["daedalus", "evaluate", *words]))
        return 2
    except RepositoryNameError as error:
        print_error("evaluate", error)
        return 2
    except _FAILURES as error:
        # The signal may also have ended the processes of the environments: their errors are not the reason then.
        print_error("evaluate", "stopped" if stop.is_set() else error)
        return 1
    say(json.dumps(result) if arguments.json else _text(result), output)
    return 0 if not arguments.record or _record(result, arguments.directory) else 1


def _record(result: dict[str, Any], directory: Path) -> bool:
    """Keep a result in a run directory, as the final evaluation does, and return whether that was possible."""
    from daedalus.cli.evaluation_processes import evaluation_summary
    from daedalus.learner.run import run_directory  # a policy of another place needs no code of the learner
    from daedalus.learner.run.settings import SettingsError

    path = directory / run_directory.EVALUATION
    try:
        run_directory.write_json(path, result)
        with suppress(SettingsError):  # training goes on, or was killed: there is no summary
            path = directory / run_directory.SUMMARY
            summary = run_directory.read_json(path)
            run_directory.write_json(path, {**summary, **evaluation_summary(result)})
    except OSError as error:
        print_error("evaluate", f"{path} cannot be written: {error.strerror}")
        return False
    return True


def _reserved_stdout() -> TextIO:
    """Return standard output for the result alone: whatever else this process prints goes to standard error.

    This includes libraries that are not Python's, and the processes of environments.
    """
    result = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8", errors="backslashreplace")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return result


def run_evaluation(arguments: argparse.Namespace, stop: threading.Event, stream: TextIO) -> dict[str, Any]:
    """Return the result of the evaluation that the arguments describe, after `check`; `stream` shows its progress."""
    policy = find_policy(_directory(arguments), arguments.newest)
    spec, modules = _environment(policy, arguments), _modules(policy, arguments)
    modules.check(spec.user_modules)
    seed = policy.spec.training.seed + 2**32 if arguments.seed is None else arguments.seed
    progress = EvaluationProgress(stream, arguments.episodes, policy.spec.evaluation.max_episode_env_steps, stop)
    filmed: dict[str, Any] = {}
    notes: list[str] = []
    try:
        if arguments.video is None:
            with Surroundings():
                evaluation = _play(policy, spec, modules, arguments, seed, progress, None)
        else:
            with (
                Video(arguments.video, width=arguments.width, max_seconds=arguments.max_seconds) as video,
                Surroundings(),
            ):
                evaluation = _play(policy, spec, modules, arguments, seed, progress, video)
            filmed = {"video": str(arguments.video), "video_seconds": video.seconds}
            if video.rate.guess:
                notes.append(f"the speed of the video: {video.rate.guess}")
    finally:
        progress.end()
    actions = _actions(policy, arguments)
    result = _result(policy, spec, evaluation, actions)
    return {**result, "notes": [*result["notes"], *notes], "seed": seed, "actions": actions, **filmed}


def _directory(arguments: argparse.Namespace) -> Path:
    """Return the run directory or checkpoint that the arguments name. Raises HubError, NoPolicyError."""
    if arguments.from_hub is not None:
        return pull(arguments.from_hub, arguments.revision)
    return arguments.directory if arguments.pretrained is None else pretrained(arguments.pretrained)


def _environment(policy: SavedPolicy, arguments: argparse.Namespace) -> EnvironmentSpec:
    """Return the environment to play: that of the training, on the backend of the evaluation."""
    trained = policy.spec.environment
    if arguments.wrap is not None:
        trained = trained.model_copy(update={"wrap": None if arguments.wrap == "none" else arguments.wrap})
    watched = arguments.video is not None or arguments.render
    backend = arguments.backend or policy.spec.evaluation.final_backend or trained.backend
    if watched:
        backend = "gymnasium"
    played = as_on_gymnasium(trained) if backend == "gymnasium" else trained.as_evaluated(backend)
    return played.model_copy(update={"processes": played.processes and backend == "gymnasium" and not watched})


def _modules(policy: SavedPolicy, arguments: argparse.Namespace) -> UserModules:
    """Return the modules that the command line allows, with that of its own --wrap."""
    own = {module_of(arguments.wrap)} if arguments.wrap not in (None, "none") else set()
    source = f"the run of {arguments.from_hub or policy.directory}"
    return UserModules(frozenset({*arguments.allow_module, *own}), source)


def _play(
    policy: SavedPolicy,
    spec: EnvironmentSpec,
    modules: UserModules,
    arguments: argparse.Namespace,
    seed: int,
    progress: EvaluationProgress,
    video: Video | None,
) -> Evaluation:
    episodes = arguments.episodes
    watched = arguments.render or video is not None
    environments = make_environments(
        spec,
        1 if watched else min(arguments.envs or environments_for(episodes, spec, policy.spec.collection), episodes),
        modules=modules,
        render_mode="rgb_array" if video is not None else "human" if arguments.render else None,
        camera=None if video is None else video.add,
        one_episode=True,
    )
    try:
        if environments.spaces != policy.spaces:
            raise EnvironmentSetupError(
                f"{spec.id} (backend {spec.backend}) has {environments.spaces}; the policy was trained on "
                f"{policy.spaces}: choose another --backend, or install the versions that the run used (versions.json)"
            )
        runtime = OnnxRuntime(policy.program, progress.stop)
        runtime.load(policy.weights)
        return play_episodes(
            runtime,
            environments,
            episodes,
            seed,
            sampled=_actions(policy, arguments) == "sampled",
            longest=policy.spec.evaluation.max_episode_env_steps,
            progress=lambda finished, mean: progress(finished, mean) or (video is not None and video.is_full),
        )
    finally:
        environments.close()


def _actions(policy: SavedPolicy, arguments: argparse.Namespace) -> str:
    return arguments.actions or policy.spec.evaluation.actions


def _result(policy: SavedPolicy, spec: EnvironmentSpec, evaluation: Evaluation, actions: str) -> dict[str, Any]:
    returns = evaluation.returns
    note = _note(evaluation, policy.spec.evaluation.max_episode_env_steps, sampled=actions == "sampled")
    return {
        "environment": spec.id,
        "backend": spec.backend,
        "checkpoint": str(policy.directory),
        "best_checkpoint": is_best(policy.directory),
        "policy_version": policy.policy_version,
        "episodes": len(returns),
        "notes": [note] if note else [],
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "length_mean": float(evaluation.lengths.mean()),
        "returns": returns.tolist(),
        "lengths": evaluation.lengths.tolist(),
    }


def _note(evaluation: Evaluation, longest: int, *, sampled: bool) -> str:
    """Return a message about episodes that were cut, or an empty string."""
    cut = int((evaluation.cut & (evaluation.lengths == longest)).sum())
    if cut:
        return cut_note(cut, len(evaluation.cut), longest, sampled=sampled)
    return "the last episode was cut at the end of the video" if evaluation.cut.any() else ""


def _text(result: dict[str, Any]) -> str:
    best = "best checkpoint, " if result["best_checkpoint"] else ""
    if is_best_in_training(Path(result["checkpoint"])):
        best = "best checkpoint by its training episodes, "
    text = (
        f"{result['environment']} (backend {result['backend']}), {best}policy version {result['policy_version']}: "
        f"return {short_number(result['return_mean'])} +- {short_number(result['return_std'])} "
        f"(from {short_number(result['return_min'])} to {short_number(result['return_max'])}) "
        f"over {result['episodes']} {result['actions']} episodes"
    )
    if "video" in result:
        text += f"\nvideo: {result['video']}, {result['video_seconds']:.1f} s"
    return "\n".join([text, *result["notes"]])


if __name__ == "__main__":
    exit_on_thread_exceptions(plays=True)
    open_standard_streams()  # before descriptors are opened
    stopped, result = stop_on_signals(exit_if_stuck=True), _reserved_stdout()
    sys.exit(exit_status(lambda: main(stop=stopped, output=result), result))
