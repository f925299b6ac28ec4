"""Whether a run in a run directory has finished, from its files. Without torch."""

from dataclasses import dataclass
from pathlib import Path

from daedalus.learner.run.counters import RunCounters, check_counters
from daedalus.learner.run.run_directory import SUMMARY, read_json
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import exact_number


@dataclass(frozen=True, slots=True, kw_only=True)
class FinishedRun:
    """Run that has nothing left to train."""

    reason: str  # why, and how to go on
    missed: bool  # whether the budget was used up before the target at which the run was to stop
    to_evaluate: bool  # whether training ended by itself, and the final evaluation is missing


def finished_run(directory: Path, spec: RunSpec) -> FinishedRun | None:
    """Return how a run has finished under a specification, or None if there is something left to train.

    A learner that was killed between its last checkpoint and its summary has to be started again.
    """
    counters = _newest_counters(directory, spec)
    try:
        summary = read_json(directory / SUMMARY)
    except SettingsError:
        return None
    if counters is None or summary.get("env_steps") != counters.env_steps:
        return None
    training = spec.training
    solved = counters.is_solved(spec) and bool(summary.get("solved"))  # not while new episodes have to confirm it
    if solved and training.stop_when_solved:
        reason = (
            f"the target return {exact_number(training.target_return)} was reached, and {counters.env_steps:,} "
            "env_steps are done: train on with --set training.stop_when_solved=false, or raise training.target_return"
        )
    elif counters.env_steps >= training.env_steps:
        reason = (
            f"{counters.env_steps:,} env_steps are done, and the budget is {training.env_steps:,}: "
            "raise it with --env-steps"
        )
    else:
        return None
    missed = training.target_return is not None and training.stop_when_solved and not solved
    to_evaluate = bool(summary.get("finished")) and summary.get("evaluation") is None
    return FinishedRun(reason=reason, missed=missed, to_evaluate=to_evaluate)


def _newest_counters(directory: Path, spec: RunSpec) -> RunCounters | None:
    for checkpoint in checkpoints(directory):
        counters = RunCounters(spec.training.target_episodes)
        try:
            counters.restore(check_counters(SealedDirectory(checkpoint).content["counters"]))
        except (DamagedError, KeyError, ValueError):
            continue  # the learner reports it
        return counters
    return None
