"""What `daedalus evaluate` and `daedalus.evaluate` can be asked for, and the policy and environment that are meant."""

import os
import re
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import as_on_gymnasium
from daedalus.actor.evaluation.video import FORMATS
from daedalus.launch.environment_object import NO_ENVIRONMENT, EnvironmentObject
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.saving.hub import pull
from daedalus.policy.saving.saved_policy import SavedPolicy, find_policy, pretrained
from daedalus.policy.user_modules import UserModules, module_of
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import Backend, EnvironmentSpec

EPISODES = 100  # without a video or a window
GAMES = 200  # against an opponent
_MOST_EPISODES = 1_000_000  # their results are held in memory
_MOST_OPENINGS = 1000
FINAL_SEEDS = 2**32  # added to the seed of the run for its final episodes: training uses none of these seeds
_WIDTHS = range(16, 4097)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationOptions:
    """Which policy to evaluate, and how; None: the default. Raises ValueError for options that cannot be used."""

    directory: Path | None = None  # a run directory, or one of its checkpoints
    pretrained: str | None = None  # the name of a policy of the package, in place of a directory
    from_hub: str | None = None  # USER/NAME, in place of a directory
    revision: str | None = None  # of `from_hub`
    newest: bool = False  # the newest checkpoint of the run, not the best
    episodes: int | None = None  # or games, with `against`
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
    against: str | None = (
        None  # the opponent in a game: a directory, a kept version (v120), random, module:Bot, USER/NAME
    )
    openings: int = 0  # random env_steps at the start of each game

    @property
    def watched(self) -> bool:
        """Whether the episodes are shown or filmed, with one environment."""
        return self.video is not None or self.render

    @property
    def count(self) -> int:
        """Number of episodes."""
        if self.episodes is not None:
            return self.episodes
        return GAMES if self.against is not None else 1 if self.watched else EPISODES

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
        if watched and self.against is not None:
            raise ValueError(f"{watched} cannot show games with several agents yet: leave it out")
        if self.openings and self.against is None:
            raise ValueError("--openings needs --against OPPONENT: add it, or leave --openings out")
        if not 0 <= self.openings <= _MOST_OPENINGS:
            raise ValueError(f"--openings is {self.openings}: choose a number from 0 to {_MOST_OPENINGS}")
        if self.render and not _has_screen():
            raise ValueError(
                "--render needs a screen, and this machine has none: record the episodes with --video FILE.mp4"
            )


def _has_screen() -> bool:
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def chosen_policy(options: EvaluationOptions) -> SavedPolicy:
    """Return the policy that the options name.

    Raises HubError, NoPolicyError and DamagedError, and ValueError if it was trained on another environment than `env`.
    """
    policy = find_policy(_directory(options), options.newest)
    trained = policy.spec.environment.id
    if not options.env.is_for(trained):
        raise ValueError(f"env is {options.env.id}, and the policy was trained on {trained}: leave env out")
    return policy


def _directory(options: EvaluationOptions) -> Path:
    """Return the run directory or checkpoint that the options name. Raises HubError, NoPolicyError."""
    if options.from_hub is not None:
        return pull(options.from_hub, options.revision)
    if options.pretrained is not None:
        return pretrained(options.pretrained)
    assert options.directory is not None
    return options.directory


def environment_of(policy: SavedPolicy, options: EvaluationOptions) -> EnvironmentSpec:
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


def modules_of(policy: SavedPolicy, options: EvaluationOptions) -> UserModules:
    """Return the modules that the command line allows, with those of its own --wrap and --against."""
    own = {module_of(name) for name in (options.wrap, options.against) if name is not None and ":" in name}
    source = f"the run of {options.from_hub or policy.directory}"
    return UserModules(frozenset({*options.allowed_modules, *own}), source)


def actions_of(policy: SavedPolicy, options: EvaluationOptions) -> str:
    """Return "greedy" or "sampled"."""
    return options.actions or policy.spec.evaluation.actions


def loaded_runtime(policy: SavedPolicy, stop: threading.Event) -> OnnxRuntime:
    """Return what runs a policy, with its weights. `stop` ends a call; it then raises PolicyError."""
    runtime = OnnxRuntime(policy.program, stop)
    runtime.load(policy.weights)
    return runtime


def check_spaces(spaces: Spaces, spec: EnvironmentSpec, policy: SavedPolicy) -> None:
    """Raise EnvironmentSetupError if an environment that was made has other spaces than the policy."""
    if spaces != policy.spaces:
        raise EnvironmentSetupError(
            f"{spec.id} (backend {spec.backend}) has {spaces}; the policy was trained on {policy.spaces}: choose "
            "another --backend, or install the versions that the run used (versions.json)"
        )
