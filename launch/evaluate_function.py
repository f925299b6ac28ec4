"""`daedalus.evaluate`: the command `daedalus evaluate` as a function."""

import argparse
import io
import operator
import threading
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.cli.commands.evaluate import run_evaluation
from daedalus.cli.commands.evaluate_arguments import check, parser
from daedalus.policy.user_modules import ModuleNotAllowedError, refuse_while_imported
from daedalus.protocol.spec import Backend


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
    arguments = parser().parse_args([])
    arguments.directory = None if directory is None else Path(directory)
    arguments.newest, arguments.pretrained = newest, pretrained
    arguments.from_hub, arguments.revision = from_hub, revision
    arguments.episodes, arguments.seed, arguments.actions, arguments.backend = episodes, seed, actions, backend
    arguments.video = None if video is None else Path(video)
    arguments.width, arguments.max_seconds = width, max_seconds
    arguments.allow_module = list(allow_modules)
    _check_values(arguments)
    check(arguments)
    try:
        result = run_evaluation(arguments, threading.Event(), io.StringIO())
    except ModuleNotAllowedError as error:
        remedy = f"if you trust that code, pass allow_modules={list(error.modules)}"
        raise EnvironmentSetupError(f"{error.reason}; {remedy}") from None
    return EvaluationResult(
        returns=np.array(result["returns"], np.float64),
        lengths=np.array(result["lengths"], np.int64),
        video=arguments.video,
        notes=tuple(result["notes"]),
        **{
            name: result[name]
            for name in (
                "return_mean",
                "return_std",
                "environment",
                "backend",
                "actions",
                "seed",
                "policy_version",
                "best_checkpoint",
            )
        },
    )


def _check_values(arguments: argparse.Namespace) -> None:
    """Raise ValueError for values that the command line cannot have."""
    for name, choices in (("actions", ("greedy", "sampled")), ("backend", get_args(Backend))):
        value = getattr(arguments, name)
        if value is not None and value not in choices:
            raise ValueError(f"{name} is {value!r}: choose from {', '.join(choices)}")
    for name in ("episodes", "seed", "width"):
        value = getattr(arguments, name)
        try:
            setattr(arguments, name, None if value is None else operator.index(value))
        except TypeError:
            raise ValueError(f"{name} is {value!r}: it must be a whole number") from None
