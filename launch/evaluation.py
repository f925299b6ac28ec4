"""Evaluation of a saved policy: `daedalus.evaluate`, which the command `daedalus evaluate` calls as well."""

import io
import operator
import threading
from collections.abc import Callable, Collection
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO, get_args

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.given_environment import giving
from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.episodes import (
    Evaluation,
    EvaluationProgress,
    cut_note,
    environments_for,
    play_episodes,
)
from daedalus.actor.evaluation.video import Video
from daedalus.launch.environment_object import environment_object
from daedalus.launch.evaluation_options import (
    FINAL_SEEDS,
    EvaluationOptions,
    actions_of,
    check_spaces,
    chosen_policy,
    environment_of,
    loaded_runtime,
    modules_of,
)
from daedalus.launch.match_evaluation import MatchScores, evaluated_matches
from daedalus.policy.saving.best_checkpoints import evaluation_result
from daedalus.policy.saving.saved_policy import SavedPolicy
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import ModuleNotAllowedError, refuse_while_imported
from daedalus.protocol.spec import Backend, EnvironmentSpec

if TYPE_CHECKING:
    import gymnasium

_SAME_IN_RESULT = (
    *("return_mean", "return_std", "environment", "backend"),
    *("actions", "seed", "policy_version", "best_checkpoint"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluationResult:
    """Result of an evaluation, with unscaled rewards."""

    returns: np.ndarray  # [episodes] float64
    lengths: np.ndarray  # [episodes] int64, env_steps of each episode
    return_mean: float
    return_std: float  # of the episodes, with n in the denominator
    environment: str
    backend: str
    actions: str  # "greedy" or "sampled"
    seed: int
    policy_version: int
    best_checkpoint: bool  # whether the policy is the best checkpoint of its run
    video: Path | None  # the file that was recorded
    notes: tuple[str, ...]  # such as that episodes were cut
    matches: MatchScores | None = None  # with `against`


def evaluate(
    directory: str | Path | None = None,
    *,
    env: "gymnasium.Env | Callable[..., gymnasium.Env] | None" = None,
    newest: bool = False,
    pretrained: str | None = None,
    from_hub: str | None = None,
    revision: str | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    actions: Literal["greedy", "sampled"] | None = None,
    backend: Backend | None = None,
    video: str | Path | None = None,
    width: int | None = None,
    max_seconds: float | None = None,
    against: str | Path | None = None,
    openings: int = 0,
    allow_modules: Collection[str] = (),
) -> EvaluationResult:
    """Play new episodes with the policy of a run, and return their returns. Prints nothing.

    Args:
      directory: a run directory, or one of its checkpoints; of a run the best checkpoint, else the newest.
      env: the environment, if `daedalus.train` played an object that no module has: its class, a function that returns
        one, or an instance.
      newest: use the newest checkpoint of the run, not the best.
      pretrained: the name of a policy that ships with the package, in place of a directory.
      from_hub: USER/NAME of a policy on the Hugging Face Hub, in place of a directory.
      revision: branch, tag or commit on the Hub (default: the newest of main).
      episodes: number of episodes (default: 100, or 1 with a video).
      seed: of the environments (default: one that training did not use).
      actions: "greedy" or "sampled" (default: evaluation.actions of the run).
      backend: implementation of the environment (default: evaluation.final_backend of the run, or that of training).
      video: record the episodes as this file, .mp4 or .gif, on gymnasium's implementation.
      width: of the video, in pixels.
      max_seconds: length of the video; the evaluation ends with it.
      against: the opponent in a game with several agents: a run directory, one of its checkpoints, a version that the
        run's league kept ("v120"), "random", "module:Bot", or USER/NAME on the Hub. The policy plays from every side in
        turn, the opponent plays all others; an episode is a game (default: 200).
      openings: number of random env_steps at the start of each game against an opponent. Two players without chance
        play the same game again and again otherwise.
      allow_modules: modules that may be imported to make the run's environment. Importing a module runs it, and a file
        named it.

    Raises ValueError for invalid arguments, NoPolicyError if there is no checkpoint or no such pretrained policy,
    DamagedError if none can be read, HubError if a policy cannot be pulled, EnvironmentSetupError if the environment
    cannot be made or needs a module that is not allowed, VideoError if the video cannot be written, and RuntimeError if
    the module of the environment calls it while it is imported.
    """
    refuse_while_imported("daedalus.evaluate")
    for name, value, choices in (("actions", actions, ("greedy", "sampled")), ("backend", backend, get_args(Backend))):
        if value is not None and value not in choices:
            raise ValueError(f"{name} is {value!r}: choose from {', '.join(choices)}")
    given = environment_object(env)
    options = EvaluationOptions(
        directory=None if directory is None else Path(directory),
        newest=newest,
        pretrained=pretrained,
        from_hub=from_hub,
        revision=revision,
        episodes=_whole_number("episodes", episodes),
        seed=_whole_number("seed", seed),
        actions=actions,
        backend=backend,
        video=None if video is None else Path(video),
        width=_whole_number("width", width),
        max_seconds=max_seconds,
        against=None if against is None else str(against),
        openings=_whole_number("openings", openings) or 0,
        allowed_modules=frozenset({*allow_modules, *given.modules}),
        env=given,
    )
    try:
        result = run_evaluation(options, threading.Event(), io.StringIO())
    except ModuleNotAllowedError as error:
        raise EnvironmentSetupError(error.in_python) from None
    return EvaluationResult(
        returns=np.array(result["returns"], np.float64),
        lengths=np.array(result["lengths"], np.int64),
        video=options.video,
        notes=tuple(result["notes"]),
        matches=result.get("matches"),
        **{name: result[name] for name in _SAME_IN_RESULT},
    )


def _whole_number(name: str, value: object) -> int | None:
    """Return an optional whole number of any type, such as one of NumPy. Raises ValueError."""
    try:
        return None if value is None else operator.index(value)  # pyright: ignore[reportArgumentType]  # it raises
    except TypeError:
        raise ValueError(f"{name} is {value!r}: it must be a whole number") from None


def run_evaluation(options: EvaluationOptions, stop: threading.Event, stream: TextIO) -> dict[str, Any]:
    """Return the result of the evaluation that the options describe. `stream` shows its progress."""
    policy = chosen_policy(options)
    trained = policy.spec.environment.id
    if options.against is not None:
        return evaluated_matches(policy, options, _seed(policy, options), stop, stream)
    with nullcontext() if options.env.maker is None else giving(trained, options.env.maker):
        return _evaluated(policy, options, stop, stream)


def _evaluated(
    policy: SavedPolicy, options: EvaluationOptions, stop: threading.Event, stream: TextIO
) -> dict[str, Any]:
    spec = environment_of(policy, options)
    modules_of(policy, options).check(spec.user_modules)
    progress = EvaluationProgress(stream, options.count, policy.spec.evaluation.max_episode_env_steps, stop)
    try:
        with (
            Video(options.video, width=options.width, max_seconds=options.max_seconds)
            if options.video
            else nullcontext() as video,
            Surroundings(),
        ):
            evaluation = _play(policy, spec, options, progress, video)
    finally:
        progress.end()
    filmed: dict[str, Any] = {}
    actions = actions_of(policy, options)
    result = _result(policy, spec, evaluation, actions)
    if video is not None:
        filmed = {"video": str(options.video), "video_seconds": video.seconds}
        if video.rate.guess:
            result["notes"].append(f"the speed of the video: {video.rate.guess}")
    return {**result, "seed": _seed(policy, options), "actions": actions, **filmed}


def _seed(policy: SavedPolicy, options: EvaluationOptions) -> int:
    return policy.spec.training.seed + FINAL_SEEDS if options.seed is None else options.seed


def _play(
    policy: SavedPolicy,
    spec: EnvironmentSpec,
    options: EvaluationOptions,
    progress: EvaluationProgress,
    video: Video | None,
) -> Evaluation:
    episodes = options.count
    watched = options.watched
    environments = make_environments(
        spec,
        1 if watched else min(options.envs or environments_for(episodes, spec, policy.spec.collection), episodes),
        modules=modules_of(policy, options),
        render_mode="rgb_array" if video is not None else "human" if options.render else None,
        camera=None if video is None else video.add,
        one_episode=True,
    )
    try:
        check_spaces(environments.spaces, spec, policy)
        return play_episodes(
            loaded_runtime(policy, progress.stop),
            environments,
            episodes,
            _seed(policy, options),
            sampled=actions_of(policy, options) == "sampled",
            longest=policy.spec.evaluation.max_episode_env_steps,
            progress=lambda finished, mean: progress(finished, mean) or (video is not None and video.is_full),
        )
    finally:
        environments.close()


def _result(policy: SavedPolicy, spec: EnvironmentSpec, evaluation: Evaluation, actions: str) -> dict[str, Any]:
    note = _note(spec, evaluation, policy.spec.evaluation.max_episode_env_steps, sampled=actions == "sampled")
    returns, lengths, notes = evaluation.returns, evaluation.lengths, [note] if note else []
    result = evaluation_result(policy.directory, policy.policy_version, spec, returns, lengths, notes)
    return {**result, "returns": returns.tolist(), "lengths": lengths.tolist()}


def _note(spec: EnvironmentSpec, evaluation: Evaluation, longest: int, *, sampled: bool) -> str:
    """Return a message about episodes that were cut, or an empty string."""
    cut = int((evaluation.cut & (evaluation.lengths == longest)).sum())
    if cut:
        return cut_note(spec, cut, len(evaluation.cut), longest, sampled=sampled)
    return "the last episode was cut at the end of the video" if evaluation.cut.any() else ""
