"""`daedalus.train`: the command `daedalus train` as a function."""

import logging
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from daedalus.launch.callbacks import Callback, observed
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.environment_check import EnvironmentProblemError
from daedalus.launch.environment_object import environment_object
from daedalus.launch.local_run import LocalRun, RunEnd, RunFailedError, UnsavedError
from daedalus.launch.local_training import run_locally
from daedalus.launch.logs import LineHandler, say
from daedalus.launch.resumed_run import ResumeChoice, locked_to_resume, resumed_run, status_of
from daedalus.launch.run_choice import NewRun, RunChoice, create_run
from daedalus.launch.supervision import start
from daedalus.learner.reporting.trackers.tracker import tracker_name
from daedalus.learner.reporting.trackers.tracking import chosen_trackers
from daedalus.learner.run import run_directory
from daedalus.learner.run.resuming import FinishedRun
from daedalus.learner.run.run_lock import RunInUseError
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.user_modules import ModuleNotAllowedError, UserModuleError, refuse_while_imported
from daedalus.transport.private_address import private_address

if TYPE_CHECKING:
    import gymnasium

_logger = logging.getLogger(__name__)

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
    evaluation_return_mean: float | None  # over evaluation.final_episodes episodes of the best policy; None without any
    evaluation_return_std: float | None
    confirmation_return_mean: float | None  # over new sampled episodes; None unless training stopped at the target
    wall_seconds: float  # training, without the final evaluation
    seconds_to_target: float | None
    env_steps_per_second: float
    summary: Mapping[str, Any]  # the whole summary.json


def train(
    preset: str | Path | None = None,
    *,
    env: "str | gymnasium.Env | Callable[..., gymnasium.Env] | None" = None,
    algorithm: str | None = None,
    actors: int | None = None,
    seed: int | None = None,
    env_steps: int | None = None,
    run_dir: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    wrap: str | None = None,
    init_from: str | Path | None = None,
    allow_other_spaces: bool = False,
    demonstrations: str | Path | None = None,
    callback: Callback | None = None,
    log: str | Sequence[str] = (),
    quiet: bool = False,
) -> RunResult:
    """Train with a learner and actors as processes of this machine, evaluate the policy, and return the result.

    Works in any thread and in notebooks. An exception in this function, such as the KeyboardInterrupt of Ctrl-C, ends
    the processes. The learner saves a checkpoint before it ends, and `daedalus resume` continues from it.

    Args:
      preset: a preset such as "cartpole", or the path of a TOML file such as a run's config.toml.
      env: any gymnasium environment with default settings, instead of a preset: its id, its class, a function that
        returns one, or an instance. What no module has, such as a class of a notebook, a lambda or an instance, is
        played by forks of this process, on Linux: each plays a copy of its own, and `resume` and `evaluate` need it
        again. An instance is played by one actor.
      algorithm: "a2c", "a3c", "impala", "appo", "one_step_q", "one_step_sarsa", "n_step_q" or "sac", or
        "module:Class" for your own.
      actors: number of actor processes.
      seed: seed of the network, the environments and the actions.
      env_steps: budget, the environment steps of all actors together.
      run_dir: a new directory for the run (default: a new folder in runs/).
      settings: any other settings, such as {"training.learning_rate": 0.001}; None unsets one.
      wrap: "module:function", called with each gymnasium environment; returns the environment to play.
      init_from: another run, or one of its checkpoints, whose weights to begin with, of equal network and spaces.
      allow_other_spaces: accept `init_from` of other spaces: the weights are loaded if their shapes fit.
      demonstrations: a Minari dataset to learn from, too: its folder, or its id among the local datasets.
      callback: called with each row of metrics; it can log metrics of its own and end training.
      log: trackers to log the run to, of "wandb", "mlflow" and "trackio", or "module:Class" for a metrics writer of
        your own.
      quiet: print nothing.

    Raises SettingsError for invalid settings, TypeError for an argument of another type, TrainingError if a process
    failed, RuntimeError if the module of the environment calls it while it is imported.
    """
    started = time.monotonic()
    refuse_while_imported("daedalus.train")
    if not isinstance(preset, str | Path | None):
        raise TypeError(f"preset must be a name or a path, not {preset}: an environment is passed as env")
    _check_types(callback, settings)
    given, trackers = environment_object(env), _trackers(log)
    choice = RunChoice(
        preset=str(preset) if isinstance(preset, Path) else preset,
        env=given.id,
        algorithm=algorithm,
        seed=seed,
        env_steps=env_steps,
        actors=actors,
        wrap=wrap,
        is_instance=given.is_instance,
        settings=settings or {},
    )
    choice.refuse_two_values()
    new = NewRun(
        choice=choice,
        directory=None if run_dir is None else Path(run_dir),
        init_from=None if init_from is None else Path(init_from),
        other_spaces=allow_other_spaces,
        demonstrations=None if demonstrations is None else str(demonstrations),
    )
    with given.players() as start_player:
        with _checking(quiet):
            lock, run = create_run(new, started=started)
        with lock:
            return _trained(replace(run, log=trackers, start_player=start_player), callback, quiet)


def resume(
    run_dir: str | Path,
    *,
    env: "gymnasium.Env | Callable[..., gymnasium.Env] | None" = None,
    env_steps: int | None = None,
    settings: Mapping[str, Any] | None = None,
    reset_statistics: bool = False,
    allow_modules: Collection[str] = (),
    callback: Callback | None = None,
    log: str | Sequence[str] = (),
    quiet: bool = False,
) -> RunResult:
    """Continue a run from its newest checkpoint, as `daedalus resume` does, and return the result.

    Args:
      run_dir: the directory of the run.
      env: its environment, if that was an object which no module has. Its spaces must be those of the run.
      env_steps: new budget, with the steps already done (default: the budget of the run).
      settings: settings to change from now on. The environment, the network, the algorithm, the optimiser and the seed
        cannot change.
      reset_statistics: forget the running statistics of observations and rewards.
      allow_modules: modules that config.toml names and that may be imported. Importing a module runs it, and a file
        named it.
      callback, log, quiet: see `train`. The trackers of the run go on in any case.

    Returns the recorded result of a run that has nothing left to train. Raises as `train` does, SettingsError also for
    a directory without a run, another environment and modules that are not allowed, and TrainingError also if another
    process has the run.
    """
    started = time.monotonic()
    refuse_while_imported("daedalus.resume")
    _check_types(callback, settings)
    directory, given = Path(run_dir), environment_object(env)
    trackers = chosen_trackers(_trackers(log), directory)
    recorded = run_directory.read_config(directory).environment
    if not given.is_for(recorded.id):
        raise SettingsError(
            f"env is {given.id}, and the environment of the run in {directory} is {recorded.id}: leave env out, or "
            f"start a new run from the weights of this one, with daedalus.train(env=..., init_from={str(directory)!r})"
        )
    choice = ResumeChoice(
        directory=directory,
        env_steps=env_steps,
        settings=settings or {},
        allowed_modules=frozenset({*allow_modules, *given.modules}),
        reset_statistics=reset_statistics,
    )
    with given.players(recorded.id) as start_player:
        try:
            spec = choice.spec(from_python=given.maker is not None)
            lock, init_from = locked_to_resume(directory)
        except ModuleNotAllowedError as error:
            raise SettingsError(error.in_python) from None
        except UserModuleError as error:
            raise SettingsError(str(error)) from None
        except RunInUseError as error:
            raise TrainingError(str(error)) from None
        with lock, _checking(quiet):
            run = resumed_run(choice, spec, lock, init_from, started=started)
            if isinstance(run, FinishedRun):
                _logger.info("nothing to do: %s", run.reason)
                summary = run_directory.read_json(directory / run_directory.SUMMARY)
                return _result(directory, RunEnd(status=status_of(run), summary=summary), None)
        with lock:
            return _trained(replace(run, log=trackers, start_player=start_player), callback, quiet)


def _trained(run: LocalRun, callback: Callback | None, quiet: bool) -> RunResult:
    """Run to the end, and return the result."""
    with ExitStack() as stack:
        if run.start_player is not start and run.spec.training.target_return is not None:
            run = replace(run, player_address=stack.enter_context(private_address()))
        observer, control = stack.enter_context(observed(callback, run.directory))
        end = _run(replace(run, observer=observer), quiet)
    return _result(run.directory, end, control.stop_reason)


def _trackers(log: str | Sequence[str]) -> list[str]:
    """Return the names of the trackers. Raises SettingsError."""
    try:
        return [tracker_name(name) for name in ((log,) if isinstance(log, str) else log)]
    except ValueError as error:
        raise SettingsError(f"log: {error}") from None


def _check_types(callback: object, settings: object) -> None:
    """Raise TypeError for objects that are often given in place of an instance, or of a map.

    Raise TrainingError for a callback where a child process inherits no pipe.
    """
    if callback is not None and not hasattr(os, "killpg"):  # Windows
        raise TrainingError("this system passes no metrics to a callback: leave it out, and read metrics.csv")
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
    if not (run.resume or output.withheld or isinstance(failure, UnsavedError)):
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
