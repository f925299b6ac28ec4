"""Evaluation of a saved policy: `daedalus.evaluate`, which the command `daedalus evaluate` calls as well."""

import io
import operator
import os
import re
import sys
import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO, get_args

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.given_environment import giving
from daedalus.actor.environments.gymnasium_backend import as_on_gymnasium
from daedalus.actor.environments.make import make_environments
from daedalus.actor.evaluation.episodes import (
    Evaluation,
    EvaluationProgress,
    cut_note,
    environments_for,
    play_episodes,
)
from daedalus.actor.evaluation.video import FORMATS, Video
from daedalus.launch.environment_object import NO_ENVIRONMENT, EnvironmentObject, environment_object
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.saving.best_checkpoints import evaluation_result
from daedalus.policy.saving.hub import pull
from daedalus.policy.saving.saved_policy import SavedPolicy, find_policy, pretrained
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import ModuleNotAllowedError, UserModules, module_of, refuse_while_imported
from daedalus.protocol.spec import Backend, EnvironmentSpec

if TYPE_CHECKING:
    import gymnasium

EPISODES = 100  # without a video or a window
_MOST_EPISODES = 1_000_000  # their results are held in memory
_WIDTHS = range(16, 4097)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationOptions:
    """Which policy to evaluate, and how; None: the default. Raises ValueError for options that cannot be used."""

    directory: Path | None = None  # a run directory, or one of its checkpoints
    pretrained: str | None = None  # the name of a policy of the package, in place of a directory
    from_hub: str | None = None  # USER/NAME, in place of a directory
    revision: str | None = None  # of `from_hub`
    newest: bool = False  # the newest checkpoint of the run, not the best
    episodes: int | None = None
    seed: int | None = None
    actions: str | None = None  # "greedy" or "sampled"
    backend: Backend | None = None
    envs: int | None = None  # environments that step together
    wrap: str | None = None  # in place of environment.wrap; "none": no wrapper
    allowed_modules: frozenset[str] = frozenset()
    env: EnvironmentObject = NO_ENVIRONMENT  # that of the run, if it is passed again in Python
    video: Path | None = None
    width: int | None = None  # of the video
    max_seconds: float | None = None  # of the video
    render: bool = False  # in a window

    @property
    def watched(self) -> bool:
        """Whether the episodes are shown or filmed, with one environment."""
        return self.video is not None or self.render

    @property
    def count(self) -> int:
        """Number of episodes."""
        return self.episodes if self.episodes is not None else 1 if self.watched else EPISODES

    def __post_init__(self) -> None:
        watched = "--video" if self.video else "--render" if self.render else None
        if sum(source is not None for source in (self.directory, self.pretrained, self.from_hub)) != 1:
            raise ValueError(
                "name either a run directory (or one of its checkpoints), or --pretrained NAME, or --from-hub USER/NAME"
            )
        if self.revision is not None and self.from_hub is None:
            raise ValueError("--revision is that of a policy on the Hub: add --from-hub USER/NAME, or leave it out")
        if not 1 <= self.count <= _MOST_EPISODES:
            raise ValueError(f"--episodes is {self.count}: choose a number from 1 to {_MOST_EPISODES:,}")
        if self.envs is not None and not 1 <= self.envs <= 4096:
            raise ValueError(f"--envs is {self.envs}: choose a number from 1 to 4096")
        if self.seed is not None and self.seed < 0:
            raise ValueError(f"--seed is {self.seed}: choose 0 or more")
        if self.wrap not in (None, "none") and re.fullmatch(r"\w+(\.\w+)*:\w+", self.wrap) is None:
            raise ValueError(f"--wrap is {self.wrap}: write MODULE:FUNCTION, or none")
        if self.video and self.video.suffix.lower() not in FORMATS:
            raise ValueError(f"--video is {self.video}: the name must end with {' or '.join(FORMATS)}")
        if self.video and self.render:
            raise ValueError("--video and --render cannot be used together: run the command twice with the same --seed")
        if not self.video and (self.width is not None or self.max_seconds is not None):
            raise ValueError("--width and --max-seconds need --video FILE: add it, or leave them out")
        if self.width is not None and self.width not in _WIDTHS:
            raise ValueError(f"--width is {self.width}: choose a number from {_WIDTHS[0]} to {_WIDTHS[-1]}")
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise ValueError(f"--max-seconds is {self.max_seconds:g}: choose a number above 0")
        if watched and self.backend not in (None, "gymnasium"):
            raise ValueError(f"{watched} needs gymnasium's implementation: leave out --backend {self.backend}")
        if watched and self.envs not in (None, 1):
            raise ValueError(f"{watched} shows one environment: leave out --envs {self.envs}")
        if self.render and not _has_screen():
            raise ValueError(
                "--render needs a screen, and this machine has none: record the episodes with --video FILE.mp4"
            )


def _has_screen() -> bool:
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


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
        allowed_modules=frozenset({*allow_modules, *given.modules}),
        env=given,
    )
    try:
        result = run_evaluation(options, threading.Event(), io.StringIO())
    except ModuleNotAllowedError as error:
        remedy = f"if you trust that code, pass allow_modules={list(error.modules)}"
        raise EnvironmentSetupError(f"{error.reason}; {remedy}") from None
    return EvaluationResult(
        returns=np.array(result["returns"], np.float64),
        lengths=np.array(result["lengths"], np.int64),
        video=options.video,
        notes=tuple(result["notes"]),
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
    policy = find_policy(_directory(options), options.newest)
    trained = policy.spec.environment.id
    if not options.env.is_for(trained):
        raise ValueError(f"env is {options.env.id}, and the policy was trained on {trained}: leave env out")
    if options.env.maker is not None:
        with giving(trained, options.env.maker):
            return _evaluated(policy, options, stop, stream)
    return _evaluated(policy, options, stop, stream)


def _evaluated(
    policy: SavedPolicy, options: EvaluationOptions, stop: threading.Event, stream: TextIO
) -> dict[str, Any]:
    spec, modules = _environment(policy, options), _modules(policy, options)
    modules.check(spec.user_modules)
    seed = policy.spec.training.seed + 2**32 if options.seed is None else options.seed
    progress = EvaluationProgress(stream, options.count, policy.spec.evaluation.max_episode_env_steps, stop)
    filmed: dict[str, Any] = {}
    notes: list[str] = []
    try:
        if options.video is None:
            with Surroundings():
                evaluation = _play(policy, spec, modules, options, seed, progress, None)
        else:
            with (
                Video(options.video, width=options.width, max_seconds=options.max_seconds) as video,
                Surroundings(),
            ):
                evaluation = _play(policy, spec, modules, options, seed, progress, video)
            filmed = {"video": str(options.video), "video_seconds": video.seconds}
            if video.rate.guess:
                notes.append(f"the speed of the video: {video.rate.guess}")
    finally:
        progress.end()
    actions = _actions(policy, options)
    result = _result(policy, spec, evaluation, actions)
    return {**result, "notes": [*result["notes"], *notes], "seed": seed, "actions": actions, **filmed}


def _directory(options: EvaluationOptions) -> Path:
    """Return the run directory or checkpoint that the options name. Raises HubError, NoPolicyError."""
    if options.from_hub is not None:
        return pull(options.from_hub, options.revision)
    if options.pretrained is not None:
        return pretrained(options.pretrained)
    assert options.directory is not None
    return options.directory


def _environment(policy: SavedPolicy, options: EvaluationOptions) -> EnvironmentSpec:
    """Return the environment to play: that of the training, on the backend of the evaluation."""
    trained = policy.spec.environment
    if options.wrap is not None:
        trained = trained.model_copy(update={"wrap": None if options.wrap == "none" else options.wrap})
    if options.watched:
        return as_on_gymnasium(trained).model_copy(update={"processes": False})
    return evaluated_environment(trained, options.backend or policy.spec.evaluation.final_backend or trained.backend)


def evaluated_environment(trained: EnvironmentSpec, backend: Backend) -> EnvironmentSpec:
    """Return the environment of an evaluation on a backend, of a policy trained in another one."""
    played = as_on_gymnasium(trained) if backend == "gymnasium" else trained.as_evaluated(backend)
    return played.model_copy(update={"processes": played.processes and backend == "gymnasium"})


def _modules(policy: SavedPolicy, options: EvaluationOptions) -> UserModules:
    """Return the modules that the command line allows, with that of its own --wrap."""
    own = {module_of(options.wrap)} if options.wrap not in (None, "none") else set()
    source = f"the run of {options.from_hub or policy.directory}"
    return UserModules(frozenset({*options.allowed_modules, *own}), source)


def _play(
    policy: SavedPolicy,
    spec: EnvironmentSpec,
    modules: UserModules,
    options: EvaluationOptions,
    seed: int,
    progress: EvaluationProgress,
    video: Video | None,
) -> Evaluation:
    episodes = options.count
    watched = options.watched
    environments = make_environments(
        spec,
        1 if watched else min(options.envs or environments_for(episodes, spec, policy.spec.collection), episodes),
        modules=modules,
        render_mode="rgb_array" if video is not None else "human" if options.render else None,
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
            sampled=_actions(policy, options) == "sampled",
            longest=policy.spec.evaluation.max_episode_env_steps,
            progress=lambda finished, mean: progress(finished, mean) or (video is not None and video.is_full),
        )
    finally:
        environments.close()


def _actions(policy: SavedPolicy, options: EvaluationOptions) -> str:
    return options.actions or policy.spec.evaluation.actions


def _result(policy: SavedPolicy, spec: EnvironmentSpec, evaluation: Evaluation, actions: str) -> dict[str, Any]:
    note = _note(evaluation, policy.spec.evaluation.max_episode_env_steps, sampled=actions == "sampled")
    returns, lengths, notes = evaluation.returns, evaluation.lengths, [note] if note else []
    result = evaluation_result(policy.directory, policy.policy_version, spec, returns, lengths, notes)
    return {**result, "returns": returns.tolist(), "lengths": lengths.tolist()}


def _note(evaluation: Evaluation, longest: int, *, sampled: bool) -> str:
    """Return a message about episodes that were cut, or an empty string."""
    cut = int((evaluation.cut & (evaluation.lengths == longest)).sum())
    if cut:
        return cut_note(cut, len(evaluation.cut), longest, sampled=sampled)
    return "the last episode was cut at the end of the video" if evaluation.cut.any() else ""
