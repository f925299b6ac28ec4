"""`daedalus.train`: what `daedalus train` does, as a function."""

import logging
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from daedalus.cli.child_output import CollectedOutput, Streams
from daedalus.cli.local_run import LocalRun, RunEnd, RunFailedError, run_locally
from daedalus.cli.settings_arguments import chosen_settings, named_directory
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError, assign, run_spec


class TrainingError(Exception):
    """Training did not finish; the message holds the reason as the failed process printed it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult:
    """How a run ended, from its summary.json."""

    directory: Path
    solved: bool  # the target return was reached
    finished: bool  # solved, or the budget is used up
    exit_status: int  # of `daedalus train`: 0 target reached or asked-for steps done, 3 budget ended without the target
    env_steps: int
    updates: int
    episodes: int
    episode_return_mean: float | None  # of the newest training episodes; None if none has ended
    evaluation_return_mean: float  # over evaluation.final_episodes episodes of the best policy
    evaluation_return_std: float
    wall_seconds: float  # training, without the final evaluation
    seconds_to_target: float | None
    env_steps_per_second: float
    summary: Mapping[str, Any]  # all of summary.json


def train(
    preset: str | None = None,
    *,
    env: str | None = None,
    algorithm: str | None = None,
    actors: int | None = None,
    seed: int | None = None,
    env_steps: int | None = None,
    run_dir: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    wrap: str | None = None,
    quiet: bool = False,
) -> RunResult:
    """Train with a learner and actors as processes of this machine, evaluate the result, and return it.

    Works from any thread and in notebooks. An exception in this function, such as the KeyboardInterrupt of Ctrl-C, ends
    the processes; the learner saves a checkpoint first, from which `daedalus resume` continues.

    Args:
      preset: a preset such as "cartpole", or the path of a TOML file such as a run's config.toml.
      env: any gymnasium environment with default settings, in place of a preset; "module:Id" for your own.
      algorithm: "a2c", "a3c", "impala" or "appo".
      actors: number of actor processes.
      seed: of the network, the environments and the actions.
      env_steps: the budget, in environment steps over all actors.
      run_dir: a new directory for the run (default: a new folder in runs/).
      settings: any other settings, such as {"training.learning_rate": 0.001}; None unsets one.
      wrap: "module:function", called with each gymnasium environment; returns the environment to play.
      quiet: print nothing.

    Raises SettingsError for settings that make no run, TrainingError if a process failed.
    """
    started = time.monotonic()
    chosen = chosen_settings(preset, env, algorithm, seed=seed, env_steps=env_steps, actors=actors)
    for path, value in (settings or {}).items():
        try:
            assign(chosen, path, value)
        except SettingsError as error:
            raise SettingsError(f"settings {path!r}: {error}") from None
    spec = run_spec(chosen)
    directory = named_directory(preset, spec) if run_dir is None else Path(run_dir)
    run_directory.create(directory, spec)
    end = _run(LocalRun(directory=directory, spec=spec, started=started, wrap=wrap), quiet)
    return _result(directory, end)


def _run(run: LocalRun, quiet: bool) -> RunEnd:
    """Run to the end, with the output of the child processes passed on to this process's streams."""

    def pass_on(line: str, stream: TextIO) -> None:
        if not quiet:
            stream.write(line)
            stream.flush()

    failure: RunFailedError | None = None
    out, err = sys.stdout, sys.stderr  # a notebook replaces them; they are this cell's now
    output = CollectedOutput(lambda line: pass_on(line, out))
    errors = CollectedOutput(lambda line: pass_on(line, err))
    try:
        streams = Streams(stdout=output.descriptor, stderr=errors.descriptor)
        with _records_to(logging.NullHandler() if quiet else logging.StreamHandler(out)):
            return run_locally(run, threading.Event(), streams)
    except RunFailedError as error:
        failure = error
    finally:
        output.close()
        printed = errors.close()
    # A process that is started again fails with the same words.
    reasons = dict.fromkeys(f"{printed}\n{failure}".strip().splitlines())
    raise TrainingError("\n".join(reasons) or f"the learner ended with status {failure.status}")


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


def _result(directory: Path, end: RunEnd) -> RunResult:
    names = RunResult.__dataclass_fields__.keys() - {"directory", "exit_status", "summary"}
    fields = {name: end.summary[name] for name in names}
    return RunResult(directory=directory, exit_status=end.status, summary=end.summary, **fields)
