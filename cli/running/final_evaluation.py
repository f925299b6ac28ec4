"""The evaluation after training: of the best checkpoint."""

import threading
import time
from typing import Any

from daedalus.cli.child_output import ChildOutput
from daedalus.cli.evaluation_processes import evaluation_summary, play, without_episodes
from daedalus.cli.running.child_arguments import evaluation_arguments
from daedalus.cli.running.local_run import LocalRun
from daedalus.cli.running.sampled_evaluation import is_below_training, other_task_note, sampled_note
from daedalus.cli.running.select_best import select_best
from daedalus.learner.run import run_directory


def evaluate_run(run: LocalRun, stopping: threading.Event, output: ChildOutput) -> dict[str, Any]:
    """Select the best checkpoint, play the final episodes with it, and return the summary with the results.

    If greedy episodes are clearly worse than training was, the same episodes are played with sampled actions, too,
    unless the policy is greedy anyway, or sampled episodes have confirmed the target. A note says where training
    plays another task, whose returns say nothing about these. Raises EvaluationFailedError.
    """
    began = time.monotonic()
    summary = run_directory.read_json(run.directory / run_directory.SUMMARY)
    options = ["--episodes", str(run.spec.evaluation.final_episodes), *evaluation_arguments(run)]
    chosen = select_best(run.directory, run.spec, options, stopping, output)
    (evaluation,) = play([[str(run.directory), *options]], stopping, output)
    confirmed = summary.get("confirmation") is not None  # by sampled episodes
    can_differ = run.spec.algorithm.heads == "policy_and_value"  # the policy of action values is always greedy
    true_task = run.spec.environment.trains_true_task
    if not true_task and summary.get("episode_return_mean") is not None:
        evaluation["notes"].append(other_task_note(summary["episode_return_mean"]))
    if true_task and not confirmed and can_differ and is_below_training(evaluation, summary.get("episode_return_mean")):
        (sampled,) = play([[str(run.directory), *options, "--actions", "sampled"]], stopping, output)
        evaluation["notes"].append(sampled_note(evaluation, sampled))
        summary["sampled_evaluation"] = without_episodes(sampled)
    summary |= evaluation_summary(evaluation, select_best=chosen, seconds=time.monotonic() - began)
    run_directory.write_json(run.directory / run_directory.EVALUATION, evaluation)
    run_directory.write_json(run.directory / run_directory.SUMMARY, summary)
    return summary
