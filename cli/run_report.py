"""The last lines that `daedalus train` prints."""

import importlib.util
import shlex
import sys
from contextlib import suppress
from typing import Any

from daedalus.cli.logs import say
from daedalus.cli.processes import UNWRITABLE, discard
from daedalus.cli.running.local_run import LocalRun
from daedalus.protocol.texts import exact_number, short_number


def report(run: LocalRun, summary: dict[str, Any]) -> str:
    """Return the result of a run from its summary.json, with the evaluation."""
    target = run.spec.training.target_return
    skipped = f" ({summary['updates_skipped']:,} skipped)" if summary.get("updates_skipped") else ""
    updates = f"{summary['updates']:,} updates{skipped}"
    if summary["solved"]:
        trained = (
            f"solved: mean return {exact_number(target)} reached after {summary['seconds_to_target']:.1f} s; "
            f"{summary['env_steps']:,} env_steps, {updates} in all"
        )
    else:
        goal = "" if target is None else f" (the target {exact_number(target)} was not reached)"
        trained = f"done: {summary['env_steps']:,} env_steps, {updates}{goal}"
    evaluation = summary["evaluation"]
    evaluated = (
        f"evaluation: return {short_number(evaluation['return_mean'])} +- {short_number(evaluation['return_std'])} "
        f"over {evaluation['episodes']} {evaluation['actions']} episodes of the "
        f"{'best' if evaluation['best_checkpoint'] else 'newest'} checkpoint "
        f"on {evaluation['environment']} (backend {evaluation['backend']})"
    )
    folder = f"run directory: {run.directory}"
    if importlib.util.find_spec("matplotlib") is not None:  # an extra: the suggested command has to work
        folder += f"; draw the curves with: daedalus plot {shlex.quote(str(run.directory))} --output curve.png"
    return "\n".join([trained, *_confirmed(run, summary), evaluated, *evaluation["notes"], folder])


def show(text: str, command: str) -> None:
    """Print the result of a run. A full disk is no fault of the run: standard error has one line of `command` then."""
    try:
        say(text)
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        discard(sys.stdout)
        with suppress(OSError):
            message = f"cannot print the result, which is in the run directory: {error.strerror}"
            say(f"{command}: {message}", sys.stderr)


def _confirmed(run: LocalRun, summary: dict[str, Any]) -> list[str]:
    """Return the line about the new episodes that confirm "solved", if there is one."""
    confirmation = summary.get("confirmation")
    if confirmation is None:
        return []
    line = (
        f"confirmation: return {short_number(confirmation['return_mean'])} over {confirmation['episodes']} new sampled "
        "episodes of the policy at that moment"
    )
    if confirmation["interval"] is not None:
        line += ", 95 % interval {} to {}".format(*map(short_number, confirmation["interval"]))
    if run.spec.environment.trains_true_task:
        line += f"; training mean {short_number(summary['episode_return_mean'])}"
    return [line]
