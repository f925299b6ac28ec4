"""`daedalus.train`: the command `daedalus train` as a function."""

import logging
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from daedalus.launch.callbacks import Callback, observed
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.environment_check import EnvironmentProblemError
from daedalus.launch.local_run import LocalRun, RunEnd, RunFailedError, UnsavedError
from daedalus.launch.local_training import run_locally
from daedalus.launch.logs import LineHandler, say
from daedalus.launch.run_choice import NewRun, RunChoice, create_run
from daedalus.learner.reporting.trackers.tracker import tracker_name
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.user_modules import refuse_while_imported

_KEPT_ERRORS = 40  # newest lines of standard error for a TrainingError


class TrainingError(Exception):
    """Error of a training that did not finish. The message holds what the failed process printed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult:
    """Result of a run, from its summary.json."""

    directory: Path
    solved: bool  # the target return was reached
    finished: bool  # solved, or the budget is used up
    exit_status: int  # as of `daedalus train`: 0, or 3 if the budget was used up before the target
    stop_reason: str | None  # the reason that a callback gave to end training
    env_steps: int
    updates: int
    episodes: int
    episode_return_mean: float | None  # mean of the newest training episodes; None if none has ended
    evaluation_return_mean: float  # over evaluation.final_episodes episodes of the best policy
    evaluation_return_std: float
    confirmation_return_mean: float | None  # over new sampled episodes; None unless training stopped at the target
    wall_seconds: float  # training, without the final evaluation
    seconds_to_target: float | None
    env_steps_per_second: float
    summary: Mapping[str, Any]  # the whole summary.json


def train(
    preset: str | Path | None = None,
    *,
    env: str | None = None,
    algorithm: str | None = None,
    actors: int | None = None,
    seed: int | None = None,
    env_steps: int | None = None,
    run_dir: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    wrap: str | None = None,
    init_from: str | Path | None = None,
    allow_other_spaces: bool = False,
    callback: Callback | None = None,
    log: str | Sequence[str] = (),
    quiet: bool = False,
) -> RunResult:
    """Train with a learner and actors as processes of this machine, evaluate the policy, and return the result.

    Works in any thread and in notebooks. An exception in this function, such as the KeyboardInterrupt of Ctrl-C, ends
    the processes. The learner saves a checkpoint before it ends, and `daedalus resume` continues from it.

    Args:
      preset: a preset such as "cartpole", or the path of a TOML file such as a run's config.toml.
      env: any gymnasium environment with default settings, instead of a preset; "module:Id" for your own.
      algorithm: "a2c", "a3c", "impala", "appo", "one_step_q", "one_step_sarsa" or "n_step_q", or "module:Class" for
        your own.
      actors: number of actor processes.
      seed: seed of the network, the environments and the actions.
      env_steps: budget, the environment steps of all actors together.
      run_dir: a new directory for the run (default: a new folder in runs/).
      settings: any other settings, such as {"training.learning_rate": 0.001}; None unsets one.
      wrap: "module:function", called with each gymnasium environment; returns the environment to play.
      init_from: another run, or one of its checkpoints, whose weights to begin with, of equal network and spaces.
      allow_other_spaces: accept `init_from` of other spaces: the weights are loaded if their shapes fit.
      callback: called with each row of metrics; it can log metrics of its own and end training.
      log: trackers to log the run to, of "wandb", "mlflow" and "trackio", or "module:Class" for a metrics writer of
        your own.
      quiet: print nothing.

    Raises SettingsError for invalid settings, TypeError for an argument of another type, TrainingError if a process
    failed, RuntimeError if the module of the environment calls it while it is imported.
    """
    started = time.monotonic()
    refuse_while_imported("daedalus.train")
    preset = str(preset) if isinstance(preset, Path) else preset
    _check_types(preset, env, callback, settings)
    log = (log,) if isinstance(log, str) else log
    try:
        log = [tracker_name(name) for name in log]
    except ValueError as error:
        raise SettingsError(f"log: {error}") from None
    choice = RunChoice(
        preset=preset,
        env=env,
        algorithm=algorithm,
        seed=seed,
        env_steps=env_steps,
        actors=actors,
        wrap=wrap,
        settings=settings or {},
    )
    new = NewRun(
        choice=choice,
        directory=None if run_dir is None else Path(run_dir),
        init_from=None if init_from is None else Path(init_from),
        other_spaces=allow_other_spaces,
    )
    with _checking(quiet):
        lock, spec, spaces = create_run(new)
    with lock, observed(callback, lock.directory) as (observer, control):
        run = LocalRun(
            directory=lock.directory,
            spec=spec,
            started=started,
            lock=lock.inheritable,
            spaces=spaces,
            init_from=new.init_from,
            log=tuple(log),
            observer=observer,
        )
        end = _run(run, quiet)
    return _result(lock.directory, end, control.stop_reason)


def _check_types(preset: object, env: object, callback: object, settings: object) -> None:
    """Raise TypeError for objects that are often given in place of a name, or of an instance."""
    for name in (preset, env):
        if not isinstance(name, str | None):
            raise TypeError(f'env must be the id of a registered environment, such as "CartPole-v1", not {name}')
    if not isinstance(callback, Callback | None):
        raise TypeError(f"callback must be an instance of a subclass of daedalus.Callback, not {callback}")
    if not isinstance(settings, Mapping | None) or not all(isinstance(path, str) for path in settings or ()):
        raise TypeError(f'settings must be a map such as {{"training.learning_rate": 0.001}}, not {settings!r}')


@contextmanager
def _checking(quiet: bool) -> Iterator[None]:
    """Show what the check of the environment logs. Raise TrainingError for a problem that it finds."""
    try:
        with _records_to(_handler(quiet)):
            yield
    except EnvironmentProblemError as error:
        raise TrainingError(str(error)) from None


def _run(run: LocalRun, quiet: bool) -> RunEnd:
    """Run to the end, and pass the output of the child processes on to this process's streams.

    A notebook shows only what its own process prints, so the child processes cannot write to its streams themselves.
    """
    out, err = sys.stdout, sys.stderr  # a notebook replaces these streams for each cell
    errors: deque[str] = deque(maxlen=_KEPT_ERRORS)

    def write(line: str, stream: TextIO) -> None:
        if not quiet:
            say(line, stream)

    def write_error(line: str) -> None:
        errors.append(line)
        write(line, err)

    failure: RunFailedError | None = None
    log = run.directory / run_directory.OUTPUT
    output = ChildOutput(log, lambda line: write(line, out), write_error)
    try:
        with _records_to(_handler(quiet)), output:
            return run_locally(run, threading.Event(), output, output.unlimited_pipes)
    except RunFailedError as error:
        failure = error
    if not (output.withheld or isinstance(failure, UnsavedError)):
        run_directory.remove_failed(run.directory)
    # A restarted process fails with the same message.
    reasons = dict.fromkeys([*errors, *str(failure).splitlines()])
    raise TrainingError("\n".join(filter(None, reasons)) or f"the learner ended with status {failure.status}")


def _handler(quiet: bool) -> logging.Handler:
    return logging.NullHandler() if quiet else LineHandler(say)


@contextmanager
def _records_to(handler: logging.Handler) -> Iterator[None]:
    """Send the records of this process's daedalus loggers to a handler, unless the program has configured logging."""
    logger = logging.getLogger("daedalus")
    if logger.hasHandlers():
        yield
        return
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)


def _result(directory: Path, end: RunEnd, stop_reason: str | None) -> RunResult:
    names = RunResult.__dataclass_fields__.keys() - {"directory", "exit_status", "stop_reason", "summary"}
    fields = {name: end.summary[name] for name in names}
    return RunResult(
        directory=directory, exit_status=end.status, stop_reason=stop_reason, summary=end.summary, **fields
    )
